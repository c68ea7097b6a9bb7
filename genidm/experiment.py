"""A cell of Table 1, end to end: stages in order, each skipped when it is done.

    experience ──▶ replay (𝒢) ──▶ controller ──▶ test ──▶ report

Every stage has a directory that the settings it depends on name, so methods that agree
on a stage share it, and a run that was killed goes on where it was.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from genidm import controller, experience, files
from genidm.collect import collect
from genidm.config import plain
from genidm.controller import Controller
from genidm.episodes import Episodes
from genidm.errors import BadInput
from genidm.evaluate import Test, episodes, flatten, run
from genidm.experience import Experience
from genidm.fit import fit
from genidm.generalize import Replay, pairs, replay, residual
from genidm.methods import Method, literal
from genidm.robots import Robot
from genidm.scenarios import Scenarios, scenarios, tours
from genidm.store import Stage


@dataclasses.dataclass(frozen=True)
class Scale:
    """How much of the paper's protocol is run.

    Attributes:
      name: as it stands in paths and results.
      interactions: steps that are collected.
      updates: share of a method's updates that are made.
      seeds: test seeds.
      episodes: test episodes a seed.
      look_ahead: most steps to the intermediate goal. Agents that have just begun to learn
        fall so soon that few of their episodes reach further.
      share: least part of the record that is learned from: in the first half of a short one
        the agent hardly walks.
    """

    name: str
    interactions: int
    updates: float
    seeds: int
    episodes: int
    look_ahead: int = 1000
    share: float = 0.0


def scale_of(text: str, interactions: int) -> Scale:
    """What `--scale` names: "paper", "quick", or a share of the paper's numbers.

    Args:
      text: what the user gave.
      interactions: the paper's number for the robot.

    Raises:
      BadInput: it is none of these.
    """
    if text == "paper":
        return Scale("paper", interactions, 1.0, 10, 1000)
    if text == "quick":
        return Scale("quick", 300_000, 0.1, 2, 50, look_ahead=50, share=1.0)
    try:
        share = float(text)
    except ValueError:
        share = 0.0
    if not 0 < share < float("inf"):
        raise BadInput(f'--scale takes "quick", "paper" or a number above 0, not {text!r}')
    return Scale(
        name=text,
        interactions=max(1, round(interactions * share)),
        updates=min(share, 1.0),
        seeds=10,
        episodes=max(10, round(1000 * min(share, 1.0))),
        look_ahead=1000 if share > 0.2 else 50,
    )


@dataclasses.dataclass(frozen=True)
class Options:
    """What every cell takes.

    Attributes:
      scale: "paper" (A.1.2: all interactions, 10 seeds × 1000 episodes), "quick" (minutes),
        or a number: that share of the paper's interactions, updates and episodes.
      seed: collecting seed: of the experience, the replay and the fit. The test's are fixed.
      out: where runs are kept. The same command again goes on where it was.
      literal: the paper's letter instead of our settings: h = 1, whole-episode replay,
        λ = 0.25, mean latents, constant learning rate.
      episodes: test episodes a seed; as the scale says, unless given.
      results: also write the table and the figures to this directory, under the robot's name.
      test: the test (A.1.3).
    """

    scale: str = "paper"
    seed: int = 0
    out: Path = Path("runs")
    literal: bool = False
    episodes: int | None = None
    results: Path | None = None
    test: Test = dataclasses.field(default_factory=Test)


@dataclasses.dataclass(frozen=True)
class Cell:
    """One method on one robot, with one collecting seed: its stages.

    Attributes:
      robot: what is steered.
      method: how.
      scale: how much of the protocol.
      seed: collecting seed.
      root: directory of the stages.
      test: settings of the test.
    """

    robot: Robot
    method: Method
    scale: Scale
    seed: int
    root: Path
    test: Test

    def _key(self, stage: int) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.seed), stage)

    # ── experience ──────────────────────────────────────────────────────────────────────

    @functools.cached_property
    def experience_stage(self) -> Stage:
        """Where the record lies; shared by all methods with the same agent."""
        m = self.method
        config = dict(
            robot=self.robot.settings, agent=m.agent, task=m.task,
            interactions=self.scale.interactions, seed=self.seed,
        )  # fmt: skip
        return Stage.open(self.root, f"experience-{type(m.agent).__name__}-{self.seed}", config)

    def experience(self) -> Experience:
        """What the agent saw while it learned (§4.1)."""
        stage = self.experience_stage
        if not stage.done:
            record, _ = collect(
                self.robot, self.method.agent, self.scale.interactions, self.seed,
                task=self.method.task, stage=stage,
            )  # fmt: skip
            stage.finish({"interactions": record.interactions})
            return record
        return experience.load_chunks(stage.path("experience"), self.robot)

    # ── 𝒢 ───────────────────────────────────────────────────────────────────────────────

    @functools.cached_property
    def replay_stage(self) -> Stage | None:
        """Where 𝒢(E) lies; None for a method that learns from the record alone."""
        m = self.method
        if m.generalize is None:
            return None
        config = dict(
            experience=self.experience_stage.directory.name, share=m.share, generalize=m.generalize
        )
        return Stage.open(self.root, f"replay-{m.generalize.mode}-{self.seed}", config)

    def replay(self, record: Experience) -> Replay | None:
        """𝒢(E) (Def. 4) of the part of the record that the method learns from."""
        stage = self.replay_stage
        if stage is None:
            return None
        if not stage.done:
            turned = replay(self.robot, record, self._key(1), self.method.generalize)
            turned.save(stage.path("replay"))
            files.save_arrays(stage.path("residual"), residual(record, turned), {}, overwrite=True)
            stage.finish({"replayed": turned.yaw.size})
        return Replay.load(stage.path("replay"))

    # ── controller ──────────────────────────────────────────────────────────────────────

    @functools.cached_property
    def fit_stage(self) -> Stage:
        """Where the controller lies."""
        m = self.method
        source = self.replay_stage or self.experience_stage
        config = dict(
            source=source.directory.name, share=m.share, look_ahead=m.look_ahead,
            mirror=m.mirror, frame=m.frame, fit=self._fit,
        )  # fmt: skip
        return Stage.open(self.root, f"{m.name.replace(' ', '-')}-{self.seed}", config)

    @functools.cached_property
    def _fit(self) -> Any:
        settings = self.method.fit
        return dataclasses.replace(
            settings, updates=max(1, round(settings.updates * self.scale.updates))
        )

    def controller(self) -> Controller:
        """The fitted models."""
        stage, m = self.fit_stage, self.method
        if not stage.done:
            record = self.experience().first_share(m.share)
            samples = pairs(
                self.robot, record, self.replay(record), look_ahead=m.look_ahead, mirror=m.mirror
            )
            model = fit(self.robot, samples, self._key(2), self._fit, frame=m.frame, stage=stage)
            model.save(stage.path("controller"), overwrite=True)
            stage.finish(
                {
                    "robot": self.robot.name,
                    "method": m.name,
                    "interactions": self._count(self.experience_stage, "interactions"),
                    "learned_from": record.interactions,
                    "replayed": self._count(self.replay_stage, "replayed"),
                    "settings": plain(dataclasses.replace(m, fit=self._fit)),
                }
            )
            stage.clear_checkpoints()
        return controller.load(stage.path("controller"), self.robot)

    def _count(self, stage: Stage | None, what: str) -> int:
        return stage.summary()[what] if stage else 0

    # ── test ────────────────────────────────────────────────────────────────────────────

    def episodes(self, bank: Scenarios) -> Stage:
        """The test (A.1.3), and the ways of Fig. 8; returns the stage that holds them."""
        config = dict(fit=self.fit_stage.directory.name, bank=bank.digest(), test=self.test)
        stage = Stage.open(
            self.root, f"test-{self.method.name.replace(' ', '-')}-{self.seed}", config
        )
        if not stage.done:
            model, walks = self.controller(), tours(self.robot)
            outcome, ways = run(
                self.robot, model, flatten(walks, bank), self.test,
                traced=walks.yaw.size, stage=stage,
            )  # fmt: skip
            rest = jax.tree.map(lambda x: np.asarray(x)[walks.yaw.size :], outcome)
            save_test(stage, episodes(rest, bank.shape), ways)
            stage.finish(
                self.fit_stage.summary()
                | {"seed": self.seed, "scale": self.scale.name, "scenarios": bank.digest()}
                | {"test": plain(self.test), "fit": self.fit_stage.directory.name}
            )
            stage.clear_checkpoints()
        return stage


def save_test(stage: Stage, outcome: Episodes, ways: list[np.ndarray]) -> None:
    """Writes the outcome of a test, and the ways of its tours."""
    tree = {
        "episodes": dataclasses.asdict(outcome),
        "ways": {str(i): w for i, w in enumerate(ways)},
    }
    files.save_arrays(stage.path("episodes"), tree, {}, overwrite=True)


def cell(robot: Robot, method: Method, options: Options) -> Cell:
    """The cell that a method and a user's options name."""
    scale = scale_of(options.scale, robot.paper_interactions)
    method = literal(method) if options.literal else method
    return Cell(
        robot=robot,
        method=dataclasses.replace(
            method,
            look_ahead=min(method.look_ahead, scale.look_ahead),
            share=max(method.share, scale.share),
        ),
        scale=scale,
        seed=options.seed,
        root=options.out / robot.name,
        test=options.test,
    )


def run_cell(robot: Robot, method: Method, options: Options) -> Path:
    """Runs a cell to its end and writes the report of all cells beside it.

    Returns:
      the directory of the report.
    """
    from genidm.report.write import report  # drawing is not needed before the end

    this = cell(robot, method, options)
    episodes = this.scale.episodes if options.episodes is None else options.episodes
    bank = scenarios(robot, this.scale.seeds, episodes)
    this.episodes(bank)
    return report(robot, this.root, bank, this.scale.name, options.test, options.results)


def main(robot: Callable[[], Robot], method: Method) -> None:
    """The command line of a cell: `python -m experiments.ant_lr`."""

    def command(
        options: Annotated[Options, tyro.conf.arg(name="")] = Options(),
        method: Method = method,
    ) -> None:
        print((run_cell(robot(), method, options) / "table.txt").read_text())

    guarded(command, f"{method.name} on the {robot.__name__}: one cell of Table 1, end to end.")


def guarded(command: Callable[..., None], description: str) -> None:
    """Runs a command line; bad input ends in one sentence on stderr and exit status 2."""
    try:
        tyro.cli(command, description=description, config=(tyro.conf.AvoidSubcommands,))
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
