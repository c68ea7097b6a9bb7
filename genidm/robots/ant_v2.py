"""gym's Ant-v2, the Ant of the author's code (docs/authors.md): the Ant's body, other physics."""

from __future__ import annotations

import mujoco
import numpy as np

from genidm.robots.ant import Ant
from genidm.robots.mujoco import Solver

# MuJoCo's defaults, which gym's ant.xml leaves as they are.
DEFAULT_SOLVER = Solver(iterations=100, line_search=50, elliptic=False)
# gym's ant.xml: metres within which a geom is in contact.
MARGIN = 0.01


class AntV2(Ant):
    """The Ant with the physics of gym's Ant-v2.

    Friction cones are pyramidal, the integrator is RK4, and every geom collides with the floor,
    not only the feet. An episode starts with straight legs, 0.75 m above the floor. s `[111]`,
    falls and costs are those of `Ant`: gym's clips wrenches along the world's axes, and its
    quaternions have either sign.

    Where a foot slips, pyramidal cones depend on the world's axes. Under strong actions, a replay
    from a rotated start (𝒢) deviates by centimetres within 10 steps (docs/physics.md).

    Args:
      solver: settings of the constraint solver; default: MuJoCo's own.
      engine: one of `engines`; default: chosen by hardware.
    """

    name = "ant_v2"

    def __init__(self, solver: Solver | None = None, engine: str | None = None):
        super().__init__(solver or DEFAULT_SOLVER, engine)

    def _specify(self, solver: Solver) -> mujoco.MjSpec:
        """brax's model with the contacts and the integrator of gym's."""
        spec = super()._specify(solver)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        for geom in list(spec.geoms):
            geom.contype, geom.margin = 1, MARGIN
            if geom.name.endswith("_foot_geom"):
                spec.delete(geom)  # brax adds these spheres; in gym the whole leg collides
        return spec

    def rest_pose(self) -> np.ndarray:
        return self.mj_model.qpos0.astype(np.float32)
