"""VGCP on the Minitaur: one cell of Table 1."""

from genidm.experiment import main
from genidm.methods import by_name
from genidm.robots import Minitaur

if __name__ == "__main__":
    main(Minitaur, by_name("VGCP", Minitaur.name))
