"""AGENT on the Ant: one cell of Table 1."""

from genidm.paper.methods import AGENT
from genidm.robots import Ant
from genidm.runs.command import main

if __name__ == "__main__":
    main(Ant, AGENT)
