"""VGCP on the Ant: one cell of Table 1."""

from genidm.experiment import main
from genidm.methods import VGCP
from genidm.robots import Ant

if __name__ == "__main__":
    main(Ant, VGCP)
