"""AGENT on the Minitaur: one cell of Table 1."""

from genidm.paper.methods import by_name
from genidm.robots import Minitaur
from genidm.runs.command import main

if __name__ == "__main__":
    main(Minitaur, by_name("AGENT", Minitaur.name))
