"""Fig. 9, closest distance against latent size k: `python -m experiments.latent_size`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm import files
from genidm.checks import check, count, layers
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.scenarios import Scenarios
from genidm.paper import methods
from genidm.paper.methods import InverseDynamics
from genidm.report.figures import latent_sizes
from genidm.report.rows import digested, jsonable
from genidm.report.runs import Tested
from genidm.robots import Robot, by_name
from genidm.runs.cell import announce, make_run, render_run, scenarios_of
from genidm.runs.command import run_cli
from genidm.runs.fitting import InverseDynamicsRun
from genidm.runs.resolve import Options

KIND = "latent_size"  # of these tests, so that Table 1 does not show them


@dataclasses.dataclass(frozen=True)
class Sweep(Options):
    """Settings of the figure.

    Attributes:
      episodes: test episodes per test seed.
      robot: name of the robot.
      sizes: the latent sizes k.
      repeats: independent fits for each k, to the same pairs.
    """

    episodes: int | None = 200
    robot: str = "ant"
    sizes: tuple[int, ...] = (2, 5, 10, 20, 50, 111)
    repeats: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, repeats=count(), sizes=layers)
        if not self.sizes:
            raise BadInput("sizes must hold at least 1 latent size")


def sized(method: InverseDynamics, k: int) -> InverseDynamics:
    """The method with latent size k; if that is not its own, the name says so."""
    if k == method.fit.latent_size:
        return method
    fit = dataclasses.replace(method.fit, latent_size=k)
    return dataclasses.replace(method, name=f"{method.name} k={k}", fit=fit)


def cells(
    robot: Robot, method: InverseDynamics, options: Sweep
) -> dict[int, list[InverseDynamicsRun]]:
    """Latent size k → its runs, one per fit. Table 1 shares the first fit of the method's own k."""
    found: dict[int, list[InverseDynamicsRun]] = {}
    for k in sorted(set(options.sizes)):
        this = make_run(robot, sized(method, k), options)
        assert isinstance(this, InverseDynamicsRun)
        found[k] = [dataclasses.replace(this, repeat=r) for r in range(options.repeats)]
    return found


def run(robot: Robot, method: InverseDynamics, options: Sweep) -> Path:
    """Fits and tests every k that is not finished; then writes the numbers and the figure.

    Args:
      robot: the robot; Table 1 shares its experience.
      method: a method with a latent, such as LR.
      options: settings of the figure.

    Returns:
      the directory of the results.
    """
    runs = cells(robot, method, options)
    announce(robot, options.engine)
    first = next(iter(runs.values()))[0]
    scenarios = scenarios_of(first, options)
    found = {
        k: [tested(this, scenarios, options.video) for this in these] for k, these in runs.items()
    }
    tests = {k: [test.episodes for test in of_k] for k, of_k in found.items()}
    written = document(first, method.fit.latent_size, scenarios, found)
    here = first.root / "-".join([KIND, first.scale.name, *robot.engine_in_names])
    for directory in (here, options.report_dir):
        if directory:
            files.save_json(Path(directory) / f"{robot.name}_{KIND}.json", written)
            closest = {k: [stats.masked(t) for t in fits] for k, fits in tests.items()}
            path = Path(directory) / f"{robot.name}_{KIND}.png"
            latent_sizes(closest, path, method.fit.latent_size)
    files.save_text(here / "table.txt", text(written))
    return here


def tested(this: InverseDynamicsRun, scenarios: Scenarios, video: bool) -> Tested:
    """Runs a fit's test if it is not finished, and renders it if `video`."""
    stage = this.run_test(scenarios, KIND)
    if video:
        render_run(this)
    return Tested(stage.directory, stage.summary())


def document(
    first: InverseDynamicsRun, k: int | None, scenarios: Scenarios, tests: dict[int, list[Tested]]
) -> dict[str, Any]:
    """The figure as one JSON document, distances in metres.

    Args:
      first: a run of the figure.
      k: the method's own latent size.
      scenarios: of the tests.
      tests: latent size → the test of each fit.

    Returns:
      robot, scale, training_seed, scenarios, experience, settings; and sizes: k → `stats.spread`
      over its fits, with fits: `stats.summary` of each fit's test, and what `made` its stages.
    """
    fit = dataclasses.replace(first.method.fit, latent_size=k)
    return {
        "robot": first.robot.name,
        "scale": first.scale.name,
        "training_seed": first.seed,
        "scenarios": scenarios.digest(),
        "experience": first.experience_stage.directory.name,
        "settings": to_json(dataclasses.replace(first.method, fit=fit)),
        "sizes": jsonable({k: size(fits) for k, fits in tests.items()}, digits=6),
    }


def size(fits: list[Tested]) -> dict[str, Any]:
    """The numbers of one k: over all its fits, and of each fit."""
    return {
        **stats.spread([fit.episodes for fit in fits]),
        "fits": [stats.summary(fit.episodes) | {"made": made_by(fit)} for fit in fits],
    }


def made_by(test: Tested) -> dict[str, Any]:
    """Stage → what made it, with the digest of its code."""
    return {name: digested(o) for name, o in test.made.items()}


def text(written: dict[str, Any]) -> str:
    """The numbers for a terminal."""
    lines = [f"{written['robot']}, scale {written['scale']}: closest distance in metres, by k"]
    for k, point in written["sizes"].items():
        means, (low, high) = point["means"], point["fits"][0]["ci95"]
        fits = f"± {metres(point['std'])} over fits: {', '.join(map(metres, means))}"
        one = f"95 % interval over test seeds {metres(low)}–{metres(high)}"
        lines.append(f"k = {k:>3}  {metres(point['mean'])}  {fits if len(means) > 1 else one}")
    return "\n".join([*lines, ""])


def metres(value: float | None) -> str:
    """Formats metres to a millimetre; a dash if every episode diverged."""
    return "–" if value is None else f"{value:.3f}"


def latent_size(options: Annotated[Sweep, tyro.conf.arg(name="")] = Sweep()) -> None:
    """Fits and tests all sizes, and prints the numbers."""
    robot = by_name(options.robot, options.engine)
    lr = methods.by_name("LR", robot.name)
    assert isinstance(lr, InverseDynamics)
    print((run(robot, lr, options) / "table.txt").read_text(encoding="utf-8"))


if __name__ == "__main__":
    run_cli(latent_size, "Closest distance against the size of the latent (Fig. 9).")
