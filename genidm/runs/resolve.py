"""One method as it is run: method + scale + machine + what the user sets, and who set what."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from genidm import devices
from genidm.agents.frozen import Frozen
from genidm.agents.ppo import PPO
from genidm.checks import check, count, optional
from genidm.config import flat, to_json
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.paper.methods import GoalConditioned, InverseDynamics, paper_settings
from genidm.robots import Robot
from genidm.runs.scale import Scale, scale_of


@dataclasses.dataclass(frozen=True)
class Options:
    """What every cell takes.

    Attributes:
      scale: "paper" (A.1.2: all interactions, 10 seeds × 1000 episodes), "quick" (minutes),
        or a number: that share of the paper's interactions, updates and episodes.
      seed: training seed: of the experience, the replay and the fit. The test's are fixed.
      engine: what steps the robot: "mjx", or "mujoco" for MuJoCo in C; MJX on an accelerator
        and MuJoCo in C on a CPU, unless given. The Minitaur has "bullet" alone.
      run_dir: where runs are kept. The same command again goes on where it was.
      paper_settings: the paper's letter instead of our settings: h = 1, whole-episode replay,
        λ = 0.25, mean latents, constant learning rate.
      episodes: test episodes a seed; as the scale says, unless given.
      report_dir: also write the table and the figures to this directory.
      video: also render three episodes of the test: a page and a gif, beside the controller.
      other_code: take finished stages that other code made, and say so. Off, they are made anew.
      test: the test (A.1.3).
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
        # A seed has 32 bits: jax would take 2³² for 0.
        check(self, seed=count(0, 2**32 - 1), episodes=optional(count()))


def resolve(
    robot: Robot, method: GoalConditioned | InverseDynamics, options: Options
) -> GoalConditioned | InverseDynamics:
    """A method as the scale, the machine and the robot's engine have it.

    On the command line this is what the flags of a method start from, so that what the user
    sets stands, also where it equals a default.

    Raises:
      BadInput: the scale is none, or the paper has no other settings for the method.
    """
    scale = scale_of(options.scale, robot.paper_interactions)
    agent = _at_scale(method.agent, scale)
    agent = agent if devices.memory() is None else agent.for_accelerator()
    method = dataclasses.replace(method, agent=agent)
    if isinstance(method, GoalConditioned):
        if options.paper_settings:
            raise BadInput(f"{method.name} has no settings that the paper's letter would change")
        return method
    method = _fitting(paper_settings(method) if options.paper_settings else method, scale)
    if method.generalize:
        method = dataclasses.replace(method, generalize=method.generalize.on(robot))
    return method


def _at_scale(agent: Any, scale: Scale) -> Any:
    """PPO at its defaults as the scale has it, with its own layers; other agents as they are."""
    if not isinstance(agent, PPO):
        return agent
    layers = agent.policy_hidden_layer_sizes
    usual = agent == PPO(policy_hidden_layer_sizes=layers)
    return dataclasses.replace(scale.ppo, policy_hidden_layer_sizes=layers) if usual else agent


def _fitting(method: InverseDynamics, scale: Scale) -> InverseDynamics:
    """The method as far as a scale's record is long enough for it."""
    agent = method.agent
    if isinstance(agent, Frozen):
        agent = dataclasses.replace(agent, fraction=max(agent.fraction, scale.learning))
    updates = max(1, round(method.fit.updates * scale.updates))
    return dataclasses.replace(
        method,
        agent=agent,
        goal_horizon=min(method.goal_horizon, scale.goal_horizon),
        fraction=max(method.fraction, scale.fraction),
        fit=dataclasses.replace(method.fit, updates=updates),
    )


def who_set_what(
    method: GoalConditioned | InverseDynamics,
    chosen: GoalConditioned | InverseDynamics,
    given: GoalConditioned | InverseDynamics,
) -> tuple[str, ...]:
    """Which settings are not those of the method, who set them, and which are not the paper's.

    Args:
      method: with its defaults for the robot.
      chosen: as scale, engine and machine have it.
      given: as it is run.

    Returns:
      a line each for what is chosen, what the user set, and what differs from the paper.
    """
    ours = isinstance(given, InverseDynamics) and given.name == method.name
    papers = paper_settings(given) if ours else given
    lines = []
    for who, before, after in (
        ("chosen for this scale and machine", method, chosen),
        ("set by you", chosen, given),
        ("not the paper's (--paper-settings has those)", papers, given),
    ):
        changes = [c for c in differences(before, after) if not c.startswith("name ")]
        if changes:
            lines.append(f"{given.name}, {who}: {', '.join(changes)}")
    return tuple(lines)


def differences(before: Any, after: Any) -> list[str]:
    """Settings that differ, as "name value (value before)"."""
    was, now = (flat(to_json(x)) for x in (before, after))
    return [
        f"{name} {now.get(name, 'absent')} ({was.get(name, 'absent')})"
        for name in sorted(was.keys() | now.keys())
        if was.get(name) != now.get(name)
    ]
