"""A controller (s, goal − o) → a: the fitted models and the preparation of their inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from genidm import files, symmetry, trees
from genidm.agents.policy import Policy, bearing, described
from genidm.checks import WIDEST, check_value, count, layers, one_of, optional, shown
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.offline.policy import GoalPolicy
from genidm.paper.idm import NETWORKS, Architecture
from genidm.robots import Robot, by_name
from genidm.symmetry import quarters_to

Frame = Literal["world", "heading"]

PRETRAINED = Path(__file__).parent / "pretrained"


def in_frame(
    robot: Robot, input_frame: Frame, s: jax.Array, d: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Rotate s `[..., S]` and d `[..., 3]` into the input frame of a method.

    In the "heading" frame the robot faces +x, so the input is exactly invariant to yaw (Def. 3).
    An LFM learns this invariance approximately.
    """
    if input_frame == "world":
        return s, d
    yaw = robot.observation.yaw(s)
    return robot.observation.rotate(s, -yaw), symmetry.rotate_vector(d, -yaw)


def heading(robot: Robot, s: jax.Array) -> jax.Array:
    """Read the heading `[...]` from s `[..., S]`, radians; 0 for a robot without orientation."""
    if any(field.yaw for field in robot.observation.fields):
        return robot.observation.yaw(s)
    return jnp.zeros(s.shape[:-1], s.dtype)


def relative_bearing(robot: Robot, s: jax.Array, d: jax.Array) -> jax.Array:
    """Compute the bearing `[...]` of d `[..., 3]` from the heading, radians, positive to the left.

    The result is in [−π, π).
    """
    return symmetry.wrap(bearing(d) - heading(robot, s))


def direction(relative_goal: jax.Array) -> jax.Array:
    """Compute d, the unit vector of o' − o `[..., 3]` (Remark 2); zero if o' = o."""
    length = jnp.linalg.norm(relative_goal, axis=-1, keepdims=True)
    return relative_goal / jnp.maximum(length, 1e-6)


def _full_circle() -> np.ndarray:
    return np.array([-np.pi, np.pi], np.float32)


class Controller(flax.struct.PyTreeNode):
    """A fitted method: (s, relative goal) → a.

    Attributes:
      params: parameters of the models.
      mean: `[S]`, mean of the training states, in the method's input frame.
      std: `[S]`, standard deviation of the training states.
      architecture: shape of the models.
      input_frame: frame of the s and d that the models see.
      robot: robot that the models are fitted for.
      bearings: `[2]`, radians from the heading, positive to the left: 98 % of the d that the
        models were fitted to lie between these two. (−π, π) if that is not known, or if they lie
        behind the robot too.
      clip_bearing: whether d is rotated to the nearer end of `bearings` where it lies outside.
      nearest_side: whether the side of the body that is nearest to d counts as its front, as in
        the samples (`pairs.with_nearest_side`).
    """

    params: Any
    mean: jax.Array
    std: jax.Array
    architecture: Architecture = flax.struct.field(pytree_node=False)
    input_frame: Frame = flax.struct.field(pytree_node=False)
    robot: Robot = flax.struct.field(pytree_node=False)
    bearings: Any = flax.struct.field(default_factory=_full_circle)
    clip_bearing: bool = flax.struct.field(pytree_node=False, default=False)
    nearest_side: bool = flax.struct.field(pytree_node=False, default=False)

    def __call__(self, s: jax.Array, relative_goal: jax.Array) -> jax.Array:
        """Compute actions `[..., A]` in [−1, 1] from the current state and goal (Remark 1).

        Args:
          s: states `[..., S]`.
          relative_goal: `[..., 3]`, from the robot to its goal, metres.

        Raises:
          BadInput: the shapes do not fit the robot or each other, or a number is not finite.
        """
        s = self.robot.check_inputs(s, relative_goal)
        d = direction(relative_goal)
        if not self.nearest_side:
            return self._act(s, d)
        quarters = quarters_to(bearing(d), heading(self.robot, s))
        action = self._act(self.robot.observation.turn_body_by(s, quarters), d)
        return self.robot.action.turn_body_by(action, -quarters)

    def _act(self, s: jax.Array, d: jax.Array) -> jax.Array:
        if self.clip_bearing:
            d = self.inside(s, d)
        s, d = in_frame(self.robot, self.input_frame, s, d)
        return jnp.clip(self.action(self.latent(s, d)), -1.0, 1.0)

    def inside(self, s: jax.Array, d: jax.Array) -> jax.Array:
        """Rotate d `[..., 3]` about the vertical to a bearing between `bearings`.

        A bearing b in [−π, π) becomes clip(b, low, high): a d to the left stays to the left if the
        models have seen any d there.

        Args:
          s: states `[..., S]`.
          d: directions, or relative goals, in the world frame.
        """
        angle = relative_bearing(self.robot, s, d)
        return symmetry.rotate_vector(d, jnp.clip(angle, *self.bearings) - angle)

    def normalize(self, s: jax.Array) -> jax.Array:
        """Normalise states by the training statistics, and clip them to ±10."""
        return jnp.clip((s - self.mean) / self.std, -10.0, 10.0)

    def latent(self, s: jax.Array, d: jax.Array) -> jax.Array:
        """Compute γ `[..., k]` from s and d in the method's input frame (Eq. 3)."""
        return self.architecture.latent(self.params, self.normalize(s), d)

    def action(self, latent: jax.Array) -> jax.Array:
        """Compute φ(γ) `[..., A]`, not clipped (Eq. 4; Eq. 1 without an LFM)."""
        return self.architecture.action(self.params, latent)

    def fresh(self, key: jax.Array) -> dict[str, Any]:
        """Make unfitted parameters and statistics, with the same shapes as the fitted ones."""
        size = self.robot.observation.size
        return {
            "params": self.architecture.init(key, size),
            "mean": jnp.zeros(size, jnp.float32),
            "std": jnp.ones(size, jnp.float32),
            "bearings": jnp.asarray(_full_circle()),
        }

    def save(self, path: Path | str, overwrite: bool = False) -> None:
        """Write the controller as a directory, without pickle.

        Raises:
          BadInput: the path exists, and `overwrite` is not set.
        """
        names = ("params", "mean", "std", "bearings")
        leaves = jax.tree.map(np.asarray, {name: getattr(self, name) for name in names})
        meta = described(self.robot) | to_json(self.architecture)
        meta |= {"input_frame": self.input_frame, "clip_bearing": self.clip_bearing}
        meta |= {"nearest_side": self.nearest_side}
        files.save_arrays(path, leaves, meta, overwrite)

    @classmethod
    def restore(cls, tree: dict[str, Any], meta: dict[str, Any], robot: Robot) -> Controller:
        """Make a controller from the arrays and metadata that `save` wrote.

        Raises:
          BadInput: the metadata of the models is invalid.
        """
        # Older files do not have these.
        meta = dict[str, Any](network="mlp", clip_bearing=False, nearest_side=False) | meta
        for name, allowed in (
            ("action_size", count(robot.action.size, robot.action.size)),
            ("idm", layers), ("lfm", layers), ("latent_size", optional(count(1, WIDEST))),
            ("input_frame", one_of(get_args(Frame))), ("network", one_of(NETWORKS)),
            ("clip_bearing", one_of((False, True))), ("nearest_side", one_of((False, True))),
        ):  # fmt: skip
            check_value(name, meta[name], allowed)
        architecture = Architecture(
            meta["action_size"], tuple(meta["idm"]), tuple(meta["lfm"]), meta["latent_size"],
            meta["network"],
        )  # fmt: skip
        return cls(
            **tree,
            architecture=architecture,
            input_frame=meta["input_frame"],
            robot=robot,
            clip_bearing=meta["clip_bearing"],
            nearest_side=meta["nearest_side"],
        )


# Field that a kind of controller alone has in its metadata → the kind.
KINDS: dict[str, type[Controller] | type[Policy] | type[GoalPolicy]] = {
    "goal_conditioned": Policy,
    "longest_goal": GoalPolicy,
    "input_frame": Controller,
}


def pretrained(robot: str) -> Controller | Policy | GoalPolicy:
    """Load the pretrained controller of a robot, the best one in our experiments.

    Its directory, `genidm/pretrained/ROBOT`, is that of its run and holds its settings.

    Args:
      robot: name of the robot.

    Raises:
      BadInput: there is no pretrained controller for this robot.
    """
    if not (PRETRAINED / robot).is_dir():
        available = ", ".join(sorted(path.name for path in PRETRAINED.iterdir()))
        raise BadInput(f"no pretrained controller for {robot!r}; available: {available}")
    return load(PRETRAINED / robot)


def load(
    path: Path | str, robot: Robot | None = None, engine: str | None = None
) -> Controller | Policy | GoalPolicy:
    """Load a saved controller: a fitted Controller, or the policy of a baseline.

    Args:
      path: directory that a controller's `save` wrote, or the directory of its run
        (METHOD-SEED-…).
      robot: robot of the controller; None finds a registered robot by its name.
      engine: engine of the robot if `robot` is None; None takes the robot's default.

    Raises:
      BadInput: the directory is corrupt, or the controller is for another robot.
    """
    inside = Path(path) / "controller"
    place = inside if inside.is_dir() else Path(path)
    if place.exists() and not (place / files.MANIFEST).exists():
        raise BadInput(
            f"{path} holds no controller: a finished fit or baseline has it in its directory "
            "(METHOD-SEED-…)"
        )
    tree, meta = files.load_arrays(place)
    if tree.keys() - {"bearings"} != {"params", "mean", "std"} or not isinstance(meta, dict):
        raise BadInput(f"{path} holds no controller")
    made_for = meta.get("robot")
    robot = robot or by_name(made_for if isinstance(made_for, str) else "", engine)
    if made_for != robot.name:
        raise BadInput(f"{path} holds a controller for {shown(made_for)}, not for {robot.name}")
    _same_layouts(path, meta, robot)
    kinds = [kind for field, kind in KINDS.items() if field in meta]
    if not kinds:
        raise BadInput(f"{path} was made by an older version of genidm: make it again")
    try:
        made = kinds[0].restore(tree, meta, robot)
        wanted = jax.eval_shape(made.fresh, jax.random.key(0))
    except (BadInput, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise BadInput(f"{path} holds no controller: {shown(error)}") from None
    _as_wanted(path, {name: getattr(made, name) for name in wanted}, wanted)
    return made


def _same_layouts(path: Path | str, meta: dict[str, Any], robot: Robot) -> None:
    """Refuse a controller whose layouts differ from the robot's in fields or order."""
    for name in ("observation", "action"):
        saved, current = meta.get(name), described(robot)[name]
        if saved != current:
            raise BadInput(
                f"{path} is for another {name} of the {robot.name}: it has {_fields(saved)}; "
                f"the robot has {_fields(current)}"
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
    """Refuse parameters whose names, shapes or dtypes do not fit the architecture, and NaN."""
    if differs := trees.difference(trees.kinds(found), trees.kinds(wanted)):
        name, saved, expected = differs
        raise BadInput(f"{path}: {name} is {saved}, but its architecture needs {expected}")
    if not_finite := trees.not_finite(found):
        raise BadInput(f"{path}: {not_finite} holds NaN or infinity")
