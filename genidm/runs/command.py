"""The command line of a run, and one-sentence error messages for every command."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import jax
import tyro

from genidm import devices
from genidm.checkpoints import requested_seconds
from genidm.errors import BadInput, sentence
from genidm.offline.methods import AnyMethod
from genidm.renamed import refuse
from genidm.robots import Robot
from genidm.runs.cell import execute, make_exact_run
from genidm.runs.resolve import Options, resolve, who_set_what


def main(robot: Callable[..., Robot], method: AnyMethod) -> None:
    """The command line of one cell of Table 1: `python -m experiments.ant_lr`.

    The flags are parsed twice: first scale and engine, which set the defaults of the method's
    flags; then all flags.
    """
    description = f"{method.name} on the {robot.__name__}: one cell of Table 1, end to end."
    with in_sentences():
        if {"-h", "--help"} & set(sys.argv[1:]):
            _parse(_settings(method), description)
            return
        early, _ = _parse(_early, description, return_unknown_args=True)
        made = robot(**({} if early.engine is None else {"engine": early.engine}))
        chosen = resolve(made, method, early)
        options, given = _parse(_settings(chosen), description)
        this = make_exact_run(made, given, options, who_set_what(made, method, chosen, given))
        report = execute(this, options)
        print((report / "table.txt").read_text(encoding="utf-8"))


def _early(options: Annotated[Options, tyro.conf.arg(name="")] = Options()) -> Options:
    return options


def _settings(
    method: AnyMethod,
) -> Callable[..., tuple[Options, AnyMethod]]:
    """A function whose parameters are the flags of a run, for tyro."""

    def both(
        options: Annotated[Options, tyro.conf.arg(name="")] = Options(),
        method: AnyMethod = method,
    ) -> tuple[Options, AnyMethod]:
        return options, method

    return both


def run_cli(command: Callable[..., None], description: str) -> None:
    """Runs a command line; bad input or Ctrl-C ends it with one sentence on stderr."""
    with in_sentences():
        _parse(command, description)


def _parse(command: Callable[..., Any], description: str, **how: Any) -> Any:
    """Parses the command line and calls `command` with the values."""
    refuse(command, sys.argv[1:])
    return tyro.cli(command, description=description, config=(tyro.conf.AvoidSubcommands,), **how)


@contextlib.contextmanager
def in_sentences() -> Iterator[None]:
    """Ends the program with one sentence on stderr on bad input or Ctrl-C.

    The exit status is 2 for bad input, and 130 for Ctrl-C, as in a shell.
    """
    warnings.showwarning = _warn
    inherited = os.environ.get("MPLBACKEND")
    # Figures go to files: no window may open, also if Jupyter's backend is inherited.
    os.environ["MPLBACKEND"] = "Agg"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # not every terminal can show "≤"
    try:
        devices.requested()
        requested_seconds()
        try:
            yield
        finally:
            sys.stdout.flush()  # raises BrokenPipeError here, where it is caught, not at exit
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except jax.errors.JaxRuntimeError as error:
        if (said := sentence(error)) is None:
            raise
        print(f"error: {said}", file=sys.stderr)
        sys.exit(2)
    except MemoryError as error:
        print(f"error: not enough memory: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader of the output has ended, as in `… | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped: run the same command again to resume", file=sys.stderr)
        sys.exit(130)
    finally:
        os.environ.pop("MPLBACKEND")
        if inherited is not None:
            os.environ["MPLBACKEND"] = inherited


def _warn(
    message: Warning | str, category: Any, filename: str, lineno: int, file: Any = None,
    line: str | None = None,
) -> None:  # fmt: skip
    """Prints a warning without the file and line that raised it."""
    print(f"warning: {message}", file=sys.stderr)
