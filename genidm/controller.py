"""A controller: (s, goal − o) → a, the fitted models with all they need to be fed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import files, symmetry, trees
from genidm.agents.policy import Policy, described
from genidm.checks import WIDEST, check_value, count, layers, one_of, optional, shown
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.paper.idm import Architecture
from genidm.robots import Robot, by_name

Frame = Literal["world", "heading"]

PRETRAINED = Path(__file__).parent / "pretrained"


def in_frame(
    robot: Robot, input_frame: Frame, s: jax.Array, d: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """s `[..., S]` and d `[..., 3]` as a method sees them.

    In the "heading" frame the world is turned so that the robot faces +x: the input is
    then exactly invariant to yaw, which is what the LFM learns in the limit.
    """
    if input_frame == "world":
        return s, d
    yaw = robot.observation.yaw(s)
    return robot.observation.rotate(s, -yaw), symmetry.rotate_vector(d, -yaw)


def direction(relative_goal: jax.Array) -> jax.Array:
    """d, the unit vector of o' − o `[..., 3]` (Remark 2); zero where there is none."""
    length = jnp.linalg.norm(relative_goal, axis=-1, keepdims=True)
    return relative_goal / jnp.maximum(length, 1e-6)


class Controller(flax.struct.PyTreeNode):
    """A fitted method: states and where to go in, actions out.

    Attributes:
      params: of the models.
      mean: `[S]`, of the training states, in the method's input frame.
      std: `[S]`.
      architecture: shape of the models.
      input_frame: the frame that they see s and d in.
      robot: the robot that they were fitted for.
    """

    params: Any
    mean: jax.Array
    std: jax.Array
    architecture: Architecture = flax.struct.field(pytree_node=False)
    input_frame: Frame = flax.struct.field(pytree_node=False)
    robot: Robot = flax.struct.field(pytree_node=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Actions `[..., A]` in [−1, 1].

        Args:
          s: states `[..., S]`.
          relative_goal: `[..., 3]`, from the robot to where it should go, metres.

        Raises:
          BadInput: their shapes do not fit the robot, or each other.
        """
        s = self.robot.check_inputs(s, relative_goal)
        s, d = in_frame(self.robot, self.input_frame, s, direction(relative_goal))
        return jnp.clip(self.action(self.latent(s, d)), -1.0, 1.0)

    def normalize(self, s: jax.Array) -> jax.Array:
        """States by the statistics of the training data, kept within ±10."""
        return jnp.clip((s - self.mean) / self.std, -10.0, 10.0)

    def latent(self, s: jax.Array, d: jax.Array) -> jax.Array:
        """γ `[..., k]` of states and directions in the method's input frame (Eq. 3)."""
        return self.architecture.latent(self.params, self.normalize(s), d)

    def action(self, latent: jax.Array) -> jax.Array:
        """φ(γ) `[..., A]`, not clipped (Eq. 4; Eq. 1 without an LFM)."""
        return self.architecture.action(self.params, latent)

    def fresh(self, key: jax.Array) -> dict[str, Any]:
        """Parameters and statistics of the shapes that these have, not yet fitted."""
        size = self.robot.observation.size
        return {
            "params": self.architecture.init(key, size),
            "mean": jnp.zeros(size, jnp.float32),
            "std": jnp.ones(size, jnp.float32),
        }

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Writes the controller as a directory, without pickle.

        Raises:
          BadInput: there is something already, and `overwrite` is not set.
        """
        leaves = jax.tree.map(
            np.asarray, {"params": self.params, "mean": self.mean, "std": self.std}
        )
        meta = (
            described(self.robot) | {"input_frame": self.input_frame} | to_json(self.architecture)
        )
        files.save_arrays(path, leaves, meta, overwrite)

    @classmethod
    def restore(cls, tree: dict[str, Any], meta: dict[str, Any], robot: Robot) -> Controller:
        """The controller that `save` wrote, from what lies in its directory.

        Raises:
          BadInput: what it says of its models cannot be.
        """
        for name, allowed in (
            ("action_size", count(robot.action.size, robot.action.size)),
            ("idm", layers), ("lfm", layers), ("latent_size", optional(count(1, WIDEST))),
            ("input_frame", one_of(get_args(Frame))),
        ):  # fmt: skip
            check_value(name, meta[name], allowed)
        architecture = Architecture(
            meta["action_size"], tuple(meta["idm"]), tuple(meta["lfm"]), meta["latent_size"]
        )
        return cls(**tree, architecture=architecture, input_frame=meta["input_frame"], robot=robot)


def pretrained(robot: str) -> Controller | Policy:
    """A controller that comes with genidm: the best that was made for a robot of this name.

    Its directory, `genidm/pretrained/ROBOT`, says how: it is that of a run.

    Args:
      robot: name of the robot.

    Raises:
      BadInput: none comes for this robot.
    """
    if not (PRETRAINED / robot).is_dir():
        there = ", ".join(sorted(path.name for path in PRETRAINED.iterdir()))
        raise BadInput(f"no controller comes for {robot!r}; there are some for: {there}")
    return load(PRETRAINED / robot)


def load(
    path: Path | str, robot: Robot | None = None, engine: str | None = None
) -> Controller | Policy:
    """A saved controller, fitted or learned.

    Args:
      path: what `Controller.save` or `Policy.save` wrote, or the directory of the run
        (METHOD-SEED-…) that it lies in.
      robot: whose controller it is; found by its name among those that come with genidm,
        unless given.
      engine: to step that robot with, where none is given; the robot chooses, unless given.

    Raises:
      BadInput: the directory is corrupt, or the controller is another robot's.
    """
    inside = Path(path) / "controller"
    place = inside if inside.is_dir() else Path(path)
    if place.exists() and not (place / files.MANIFEST).exists():
        raise BadInput(
            f"{path} holds no controller: it lies in the directory of a fit or a baseline "
            "(METHOD-SEED-…), once that is finished"
        )
    tree, meta = files.load_arrays(place)
    if tree.keys() != {"params", "mean", "std"} or not isinstance(meta, dict):
        raise BadInput(f"{path} holds no controller")
    made_for = meta.get("robot")
    robot = robot or by_name(made_for if isinstance(made_for, str) else "", engine)
    if made_for != robot.name:
        raise BadInput(f"{path} holds a controller for {shown(made_for)}, not for {robot.name}")
    _same_layouts(path, meta, robot)
    restore = Policy.restore if "goal_conditioned" in meta else Controller.restore
    try:
        made = restore(tree, meta, robot)
        wanted = jax.eval_shape(made.fresh, jax.random.key(0))
    except (BadInput, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise BadInput(f"{path} holds no controller: {shown(error)}") from None
    _as_wanted(path, {"params": made.params, "mean": made.mean, "std": made.std}, wanted)
    return made


def _same_layouts(path: Path | str, meta: dict[str, Any], robot: Robot) -> None:
    """Refuses a controller that was made for other numbers, or for the same in another order."""
    for name in ("observation", "action"):
        there, here = meta.get(name), described(robot)[name]
        if there != here:
            raise BadInput(
                f"{path} was made for another {name} of the {robot.name}: {_fields(there)} there, "
                f"{_fields(here)} here"
            )


def _fields(listed: Any) -> str:
    try:
        return ", ".join(
            f"{shown(name)} ({shown(size)} × {shown(unit)}, {shown(kind)})"
            for name, kind, size, unit in listed
        )
    except (TypeError, ValueError):
        return "no list of fields"


def _as_wanted(path: Path | str, found: Any, wanted: Any) -> None:
    """Refuses parameters of other names, shapes or dtypes than the architecture's, or NaN."""
    if differs := trees.difference(trees.kinds(found), trees.kinds(wanted)):
        name, there, here = differs
        raise BadInput(f"{path}: {name} is {there}, where its architecture has {here}")
    if broken := trees.not_finite(found):
        raise BadInput(f"{path}: {broken} holds NaN or infinity")
