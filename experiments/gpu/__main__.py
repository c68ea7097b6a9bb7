"""The command line: `python -m experiments.gpu`."""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from experiments.gpu import jobs
from experiments.gpu.children import Clock, Ended
from experiments.gpu.jobs import Job
from experiments.gpu.results import Results, Row
from genidm.engines import ENGINES
from genidm.errors import BadInput
from genidm.progress import METRICS, read_metrics
from genidm.robots import ROBOTS
from genidm.runs.command import run_cli

# Robot → methods to run at the paper's scale, in order; methods that share a record are adjacent.
CELLS = {"ant": ("LR", "GE", "RL", "HF")}
# Fractions of the remaining time: of the trial, of all speeds, and of the speeds on MuJoCo in C.
TRIAL, SPEEDS, IN_C = 0.35, 0.45, 0.3
# With less than this many seconds left, no child starts.
LEAST = 10.0


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command.

    Attributes:
      minutes: time limit of the whole call. The same command again resumes.
      results_dir: directory of gpu.json and gpu.md.
      run_dir: directory of the runs.
      engine: engine of the runs; default: MJX on an accelerator. The speeds of all engines are
        measured in any case.
      robots: robots, one after the other.
      methods: methods to run at the given scale; default: LR, and on the Ant also GE, RL and HF.
      scale: scale of the runs; "0.01" to try this command.
      again: also repeat measurements that are already there.
    """

    minutes: float = 9.0
    results_dir: Path | str = Path("experiments/results")
    run_dir: Path | str = Path("runs/gpu")
    engine: str | None = None
    robots: tuple[str, ...] = ("ant", "humanoid")
    methods: tuple[str, ...] = ()
    scale: str = "paper"
    again: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.minutes < math.inf:
            raise BadInput(f"minutes must be a number above 0, not {self.minutes}")
        if self.engine is not None and self.engine not in ENGINES:
            raise BadInput(f"no engine is called {self.engine!r}; there are: {', '.join(ENGINES)}")
        if unknown := set(self.robots) - ROBOTS.keys():
            raise BadInput(f"no robot is called {unknown.pop()!r}; there are: {', '.join(ROBOTS)}")


class Call:
    """One call of the command.

    Args:
      options: options of the command.

    Attributes:
      failed: titles of the parts that failed.
    """

    def __init__(self, options: Options):
        self.options, self.clock = options, Clock(options.minutes)
        self.results, self.failed = Results(options.results_dir), list[str]()

    def run(self) -> str:
        """Does all parts, until the time is over.

        Returns:
          a sentence about what is done.

        Raises:
          BadInput: jax does not start here.
        """
        options = self.options
        job = Job(
            "look", str(options.results_dir), str(options.run_dir), engine=options.engine,
            scale=options.scale, minutes=options.minutes, again=options.again,
        )  # fmt: skip
        ended = jobs.start(job, self.clock.left)
        if ended.status != 0:
            raise BadInput(f"jax does not start here, or takes too long:\n{ended.said}")
        try:
            for name in options.robots:
                self._robot(replace(job, robot=name, engine=self.results.call["engine"]))
        finally:
            got = self._got()
            self.results.end(seconds=round(self.clock.used), ended=got)
        return got

    def _robot(self, job: Job) -> None:
        find, current = self.results.find, self.results.current
        if job.again or not current("trials", job.names):
            self._do(replace(job, part="trial"), TRIAL * self.clock.left)
        self._speeds(job, SPEEDS * self.clock.left)
        cells = [replace(job, part="cell", method=name) for name in self._methods(job.robot)]
        new = [self._cell(cell) for cell in cells if not find("cells", cell.names)]
        ended = [cell for cell in cells if find("cells", cell.names)]
        if ended and (any(new) or not find("reports", job.names)):
            self._do(replace(ended[0], part="report"), self.clock.left)

    def _methods(self, robot: str) -> Sequence[str]:
        return self.options.methods or CELLS.get(robot, ("LR",))

    def _speeds(self, job: Job, seconds: float) -> None:
        """Measures the speeds of all engines, those with short compilation first."""
        engines = sorted(ROBOTS[job.robot].engines or ("",), key=compiles_long)
        end = self.clock.left - seconds
        for left, engine in zip(range(len(engines), 0, -1), engines, strict=True):
            part, share = replace(job, part="speeds", engine=engine), IN_C if left > 1 else 1.0
            if job.again or not self.results.current("measured", part.names):
                self._do(part, share * (self.clock.left - end))

    def _cell(self, job: Job) -> bool:
        """Runs a cell as far as the time allows; returns whether it is finished."""
        began = time.time()
        ended = self._do(job, self.clock.left)
        for row in self.results.rows("stages"):
            if "began" in row:
                self._pause(row, began)
        return ended

    def _pause(self, row: Row, since: float) -> None:
        """Writes seconds and step of an unfinished stage to its row."""
        seconds = round(row["seconds"] + time.time() - row["began"], 1)
        rest = {name: x for name, x in row.items() if name != "began"}
        step = _step(Path(self.options.run_dir) / row["robot"], since)
        self.results.put("stages", rest | {"seconds": seconds, "step": step})

    def _do(self, job: Job, seconds: float) -> bool:
        """Does a part in a child; writes its failure, if any, and returns whether it succeeded."""
        title, seconds = _title(job), min(seconds, self.clock.left)
        if seconds < LEAST:
            print(f"{title}: no time is left for it", file=sys.stderr)
            return False
        print(f"── {title}: at most {seconds:.0f} s", file=sys.stderr)
        ended = jobs.start(job, seconds)
        names = job.names | {"part": job.part}
        if ended.status is None:
            print(f"{title}: stopped, its time is over", file=sys.stderr)
        if why := _failure(job, ended, seconds):
            print(f"error: {title} failed", file=sys.stderr)
            self.failed.append(title)
            self.results.put("failures", names | {"why": why})
        elif ended.status == 0:
            self.results.drop("failures", names)
        return ended.status == 0

    def _got(self) -> str:
        """A sentence about finished cells and unfinished stages."""
        done = [f"{x['robot']} {x['method']}" for x in self.results.rows("cells")]
        parts = [f"done: {', '.join(done) or 'no cell'}"]
        for row in self.results.rows("stages"):
            if not row["done"]:
                at = f" at step {row['step']:,}" if row.get("step") else ""
                parts.append(f"{row['robot']} {row['method']} is {row['part']}{at}")
        return "; ".join(parts)


def compiles_long(engine: str) -> bool:
    """Whether the engine of this name consists of jax operations, which compile slowly."""
    return engine in ENGINES and ENGINES[engine].on_accelerator


def _title(job: Job) -> str:
    of = job.method if job.part in ("cell", "report") else None
    names = (job.robot, of, job.part, f"on {job.stepper}")
    return " ".join(name for name in names if name)


def _failure(job: Job, ended: Ended, seconds: float) -> str | None:
    """Why a part failed; None if it succeeded, or was stopped and can resume."""
    if ended.status is None:
        late = f"did not end within {seconds:.0f} s\n{ended.said}"
        return late if job.part in ("trial", "report") else None
    status = ended.status
    how = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    return f"{how}\n{ended.said}" if status else None


def _step(root: Path, since: float) -> int | None:
    """The last step in the newest metrics of an unfinished stage under `root`; None if unknown."""
    undone = [x for x in root.glob(f"*/{METRICS}") if not x.with_name("done.json").exists()]
    newest = max(undone, key=lambda path: path.stat().st_mtime, default=None)
    if newest is None or newest.stat().st_mtime < since:
        return None
    lines = read_metrics(newest)
    return lines[-1]["step"] if lines else None


def gpu(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> None:
    """Runs all parts; the exit status is 1 if a part failed."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # exit handlers also stop the child
    call = Call(options)
    got = call.run()
    print(call.results.path.with_suffix(".md").read_text(encoding="utf-8"))
    print(f"{got}. Run the same command again to resume.")
    if call.failed:
        print(f"error: failed: {'; '.join(call.failed)}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    run_cli(gpu, "Tests, measures and uses a GPU within a time limit.")
