"""Fig. 9, closest distance against the size k: `python -m experiments.latent_size`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from genidm import files
from genidm.config import to_json
from genidm.errors import BadInput
from genidm.evaluation import stats
from genidm.evaluation.episodes import Episodes
from genidm.evaluation.scenarios import Scenarios
from genidm.paper.methods import LR, InverseDynamics
from genidm.provenance import environment
from genidm.report.figures import latent_sizes
from genidm.report.rows import jsonable
from genidm.report.runs import Tested
from genidm.robots import Robot, by_name
from genidm.runs.cell import announce, make_run, render_run, scenarios_of
from genidm.runs.command import run_cli
from genidm.runs.resolve import Options
from genidm.runs.run import InverseDynamicsRun

KIND = "latent_size"  # of the tests, which are no rows of the table


@dataclasses.dataclass(frozen=True)
class Sweep(Options):
    """What the figure takes.

    Attributes:
      episodes: test episodes a seed.
      robot: by its name.
      sizes: k, one point each.
      repeats: independent fits of each k, to the same pairs.
    """

    episodes: int | None = 200
    robot: str = "ant"
    sizes: tuple[int, ...] = (2, 5, 10, 20, 50, 111)
    repeats: int = 3

    def __post_init__(self) -> None:
        if self.repeats < 1 or not self.sizes or min(self.sizes) < 1:
            raise BadInput("the figure needs repeats, and sizes, of at least 1")


def sized(method: InverseDynamics, k: int) -> InverseDynamics:
    """The method with a latent of another size, under a name of its own."""
    if k == method.fit.latent_size:
        return method
    fit = dataclasses.replace(method.fit, latent_size=k)
    return dataclasses.replace(method, name=f"{method.name} k={k}", fit=fit)


def cells(
    robot: Robot, method: InverseDynamics, options: Sweep
) -> dict[int, list[InverseDynamicsRun]]:
    """k → its cells, one a fit. The first fit with the method's own k is that of Table 1."""
    found: dict[int, list[InverseDynamicsRun]] = {}
    for k in sorted(set(options.sizes)):
        this = make_run(robot, sized(method, k), options)
        assert isinstance(this, InverseDynamicsRun)
        found[k] = [dataclasses.replace(this, repeat=r) for r in range(options.repeats)]
    return found


def run(robot: Robot, method: InverseDynamics, options: Sweep) -> Path:
    """Fits and tests every k that is not done; then writes the numbers and the figure.

    Args:
      robot: whose experience it is; shared with Table 1.
      method: LR, or one like it.
      options: sizes, repeats, scale, places.

    Returns:
      the directory of the results.
    """
    of = cells(robot, method, options)
    announce(robot, options.engine)
    first = next(iter(of.values()))[0]
    scenarios = scenarios_of(first, options)
    tests = {
        k: [tested(this, scenarios, options.video) for this in these] for k, these in of.items()
    }
    written = document(first, method, scenarios, tests)
    here = first.root / f"{KIND}-{first.scale.name}"
    for directory in (here, options.report_dir):
        if directory:
            files.save_json(Path(directory) / f"{robot.name}_{KIND}.json", written)
            closest = {k: [stats.masked(t) for t in fits] for k, fits in tests.items()}
            path = Path(directory) / f"{robot.name}_{KIND}.png"
            latent_sizes(closest, path, method.fit.latent_size)
    files.save_text(here / "table.txt", text(written))
    return here


def tested(this: InverseDynamicsRun, scenarios: Scenarios, video: bool) -> Episodes:
    """A fit's test, made unless it is there, and its video, if that is asked for."""
    stage = this.run_test(scenarios, KIND)
    if video:
        render_run(this)
    return Tested(stage.directory, stage.summary()).episodes


def document(
    first: InverseDynamicsRun,
    method: InverseDynamics,
    scenarios: Scenarios,
    tests: dict[int, list[Episodes]],
) -> dict[str, Any]:
    """The figure as one JSON document, distances in metres.

    Returns:
      robot, scale, training_seed, scenarios, experience, settings, versions, hardware; sizes:
      k → `stats.spread` over its fits, and fits: `stats.summary` of each one's test.
    """
    found = environment()
    return {
        "robot": first.robot.name,
        "scale": first.scale.name,
        "training_seed": first.seed,
        "scenarios": scenarios.digest(),
        "experience": first.experience_stage.directory.name,
        "versions": found["versions"],
        "hardware": found["hardware"],
        "settings": to_json(method),
        "sizes": jsonable({k: size(fits) for k, fits in tests.items()}, digits=6),
    }


def size(fits: list[Episodes]) -> dict[str, Any]:
    """A point of the figure: over all fits, and each of them."""
    return {**stats.spread(fits), "fits": [stats.summary(fit) for fit in fits]}


def text(written: dict[str, Any]) -> str:
    """The numbers for a terminal."""
    lines = [f"{written['robot']}, scale {written['scale']}: closest distance in metres against k"]
    for k, point in written["sizes"].items():
        means, (low, high) = point["means"], point["fits"][0]["ci95"]
        fits = f"± {metres(point['std'])} over fits: {', '.join(map(metres, means))}"
        one = f"95 % interval over test seeds {metres(low)}–{metres(high)}"
        lines.append(f"k = {k:>3}  {metres(point['mean'])}  {fits if len(means) > 1 else one}")
    return "\n".join([*lines, ""])


def metres(value: float | None) -> str:
    """To a millimetre; a dash where every episode diverged."""
    return "–" if value is None else f"{value:.3f}"


def latent_size(options: Annotated[Sweep, tyro.conf.arg(name="")] = Sweep()) -> None:
    """Fits, tests, and prints the numbers."""
    robot = by_name(options.robot, options.engine)
    print((run(robot, LR, options) / "table.txt").read_text(encoding="utf-8"))


if __name__ == "__main__":
    run_cli(latent_size, "Closest distance against the size of the latent (Fig. 9).")
