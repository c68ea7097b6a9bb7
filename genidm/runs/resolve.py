"""The settings of a run, from method, scale, machine and user, and where each comes from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genidm import checks, devices
from genidm.agents.frozen import Frozen
from genidm.agents.ppo import PPO
from genidm.checks import check, count, optional
from genidm.config import flat, to_json
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.offline.methods import AnyMethod, OfflineGoalConditioned
from genidm.paper.methods import InverseDynamics, paper_settings
from genidm.robots import Robot
from genidm.runs.scale import Scale, scale_of


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every run.

    Attributes:
      scale: "paper" (A.1.2: all interactions, 10 seeds × 1000 episodes), "quick" (minutes),
        or a number: this fraction of the paper's interactions, updates and episodes.
      seed: training seed, of experience, replay and fit. The test seeds are fixed.
      engine: engine that steps the robot: "mjx", or "mujoco" for MuJoCo in C. Default: MJX on
        an accelerator, MuJoCo in C on a CPU. The Minitaur has only "bullet".
      run_dir: directory of the runs. The same command resumes what it finds there.
      paper_settings: use the paper's settings instead of ours: h = 1, whole-episode replay,
        λ = 0.25, mean latents, constant learning rate.
      episodes: test episodes per seed; default: as the scale sets.
      report_dir: also write the table and the figures to this directory.
      video: also render three test episodes, as a page and a gif, beside the controller.
      other_code: use finished stages that other code made, with a warning, instead of making
        them again.
      test: settings of the test (A.1.3).
    """

    scale: str = "paper"
    seed: int = 0
    engine: str | None = None
    run_dir: Path = Path("runs")
    paper_settings: bool = False
    episodes: int | None = None
    report_dir: Path | None = None
    video: bool = False
    other_code: bool = False
    test: EvaluationSettings = dataclasses.field(default_factory=EvaluationSettings)

    def __post_init__(self) -> None:
        # A seed has 32 bits: jax would treat 2³² as 0.
        check(self, seed=checks.seed(), episodes=optional(count()))


def resolve(robot: Robot, method: AnyMethod, options: Options) -> AnyMethod:
    """Adapts a method's settings to the scale, the machine and the robot's engine.

    On the command line the result gives the defaults of the method's flags, so a value that the
    user sets is never overridden, even if it equals a default of the method.

    Raises:
      BadInput: the scale is invalid, or `paper_settings` does not apply to the method.
    """
    scale = scale_of(options.scale, robot.paper_interactions)
    agent = _at_scale(method.agent, scale)
    agent = agent if devices.memory() is None else agent.for_accelerator()
    method = dataclasses.replace(method, agent=agent)
    if options.paper_settings:
        if not isinstance(method, InverseDynamics):
            raise BadInput(f"--paper-settings changes nothing in {method.name}: leave it out")
        method = paper_settings(method, robot.name)
    if isinstance(method, InverseDynamics | OfflineGoalConditioned):
        if method.generalize:
            method = dataclasses.replace(method, generalize=method.generalize.on(robot))
        return _fitting(method, scale)
    return method


def _at_scale(agent: Any, scale: Scale) -> Any:
    """Replaces PPO at default settings by the scale's, keeping layers and mirror; others stay.

    An agent that is frozen learns for at least the scale's fraction of the interactions.
    """
    if isinstance(agent, Frozen):
        fraction = max(agent.fraction, scale.min_learning_fraction)
        return dataclasses.replace(agent, fraction=fraction)
    if not isinstance(agent, PPO):
        return agent
    kept = {name: getattr(agent, name) for name in ("policy_hidden_layer_sizes", "mirror")}
    return dataclasses.replace(scale.ppo, **kept) if agent == PPO(**kept) else agent


def _fitting(method: InverseDynamics | OfflineGoalConditioned, scale: Scale) -> AnyMethod:
    """Adapts updates, horizon and fractions to the scale's shorter record."""
    # The scale asks for the whole record in place of its first half, not of its last.
    fraction = method.fraction if method.skip else max(method.fraction, scale.fraction)
    changes: dict[str, Any] = dict(fraction=fraction)
    if isinstance(method, InverseDynamics):
        changes["goal_horizon"] = min(method.goal_horizon, scale.goal_horizon)
        changes["fit"] = _fewer_updates(method.fit, scale)
    else:
        changes["learner"] = _fewer_updates(method.learner, scale)
    return dataclasses.replace(method, **changes)


def _fewer_updates(settings: Any, scale: Scale) -> Any:
    return dataclasses.replace(settings, updates=max(1, round(settings.updates * scale.updates)))


def who_set_what(
    robot: Robot, method: AnyMethod, chosen: AnyMethod, given: AnyMethod
) -> tuple[str, ...]:
    """Says which settings of a run differ from the method's defaults or from the paper, and why.

    Args:
      robot: the robot.
      method: the method with its defaults for the robot.
      chosen: the method adapted to scale, engine and machine (`resolve`).
      given: the method as it runs.

    Returns:
      up to three lines: settings that `resolve` chose, that the user set, and that differ from
      the paper.
    """
    papers = paper_settings(given, robot.name) if isinstance(given, InverseDynamics) else given
    lines = []
    for origin, before, after in (
        ("chosen for this scale and machine", method, chosen),
        ("set by you", chosen, given),
        ("unlike the paper (see --paper-settings)", papers, given),
    ):
        changes = [c for c in differences(before, after) if not c.startswith("name ")]
        if changes:
            lines.append(f"{given.name}, {origin}: {', '.join(changes)}")
    return tuple(lines)


def differences(before: Any, after: Any) -> list[str]:
    """The settings that differ, each as "name value (value before)"."""
    was, now = (flat(to_json(x)) for x in (before, after))
    return [
        f"{name} {now.get(name, 'absent')} ({was.get(name, 'absent')})"
        for name in sorted(was.keys() | now.keys())
        if was.get(name) != now.get(name)
    ]
