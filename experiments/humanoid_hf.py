"""HF on the Humanoid: one cell of Table 1."""

from genidm.experiment import main
from genidm.methods import by_name
from genidm.robots import Humanoid

if __name__ == "__main__":
    main(Humanoid, by_name("HF", Humanoid.name))
