"""Renamed flags: a command that gets an old flag names the new one in its error message."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from genidm.errors import BadInput

_AGENT = {
    "lanes": "num-envs",
    "unroll": "unroll-length",
    "epochs": "num-updates-per-batch",
    "minibatches": "num-minibatches",
    "discount": "discounting",
    "gae": "gae-lambda",
    "clip": "clipping-epsilon",
    "entropy": "entropy-cost",
    "reward-scale": "reward-scaling",
    "hidden": "policy-hidden-layer-sizes",
    "value-hidden": "value-hidden-layer-sizes",
    "critic-hidden": "critic-hidden-layer-sizes",
    "max-gradient": "max-grad-norm",
    "updates": "grad-updates-per-step",
    "batch": "batch-size",
    "capacity": "max-replay-size",
    "warmup": "min-replay-size",
    "her.goals": "her.n-sampled-goal",
    "her.strategy": "her.goal-selection-strategy",
}

RENAMED = {
    "--out": "--run-dir",
    "--results": "--report-dir",
    "--literal": "--paper-settings",
    "--extra": "--include-hf",
    "--spread-episodes": "--episodes-per-extra-seed",
    "--reach": "--goal-radius",
    "--lanes": "--num-envs",
    "--bank": "--scenarios",
    "--test.reach": "--test.goal-radius",
    "--test.lanes": "--test.num-envs",
    "--method.share": "--method.fraction",
    "--method.look-ahead": "--method.goal-horizon",
    "--method.frame": "--method.input-frame",
    "--method.task.reach": "--method.task.goal-radius",
    "--method.generalize.lanes": "--method.generalize.num-envs",
    "--method.fit.batch": "--method.fit.batch-size",
    "--method.fit.decay": "--method.fit.cosine-decay",
    "--method.fit.latent-weight": "--method.fit.latent-loss-weight",
    "--method.fit.averaged": "--method.fit.mean-latent",
    "--method.agent.share": "--method.agent.fraction",
    **{f"--method.agent.{old}": f"--method.agent.{new}" for old, new in _AGENT.items()},
    **{f"--method.agent.agent.{old}": f"--method.agent.agent.{new}" for old, new in _AGENT.items()},
}
"""Old flag → new flag. Both turn a switch off with `no-` before the last word."""


def refuse(command: Callable[..., Any], arguments: Sequence[str]) -> None:
    """Raises BadInput for a renamed flag, unless the command has a flag of the old name.

    Args:
      command: the function whose flags tyro parses.
      arguments: the command line, without the program.

    Raises:
      BadInput: an argument is an old flag; the message names the new flag.
    """
    names = set(_names(command))
    for argument in arguments:
        flag = argument.partition("=")[0].replace("_", "-")
        switch = _without_no(flag)
        old = flag if flag in RENAMED else switch
        if old not in RENAMED or old[2:] in names:
            continue
        new = RENAMED[old]
        if "." in new or new[2:] in names:
            raise BadInput(f"{flag} is now called {_with_no(new) if old != flag else new}")


def _names(command: Callable[..., Any]) -> Iterator[str]:
    """The top-level flags of a command, without dashes."""
    for parameter in inspect.signature(command).parameters.values():
        yield parameter.name.replace("_", "-")
        if dataclasses.is_dataclass(parameter.default):
            yield from (f.name.replace("_", "-") for f in dataclasses.fields(parameter.default))


def _without_no(flag: str) -> str:
    head, dot, last = flag.removeprefix("--").rpartition(".")
    return f"--{head}{dot}{last.removeprefix('no-')}"


def _with_no(flag: str) -> str:
    head, dot, last = flag.removeprefix("--").rpartition(".")
    return f"--{head}{dot}no-{last}"
