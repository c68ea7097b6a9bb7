"""AGENT on the Humanoid: one cell of Table 1."""

from genidm.paper.methods import by_name
from genidm.robots import Humanoid
from genidm.runs.command import main

if __name__ == "__main__":
    main(Humanoid, by_name("AGENT", Humanoid.name))
