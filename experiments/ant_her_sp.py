"""HER_SP on the Ant: one cell of Table 1."""

from genidm.experiment import main
from genidm.methods import HER_SP
from genidm.robots import Ant

if __name__ == "__main__":
    main(Ant, HER_SP)
