"""HER_DE on the Ant: one cell of Table 1."""

from genidm.paper.methods import HER_DE
from genidm.robots import Ant
from genidm.runs.command import main

if __name__ == "__main__":
    main(Ant, HER_DE)
