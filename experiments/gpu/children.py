"""Child processes with a time limit."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import IO, NamedTuple

# Seconds between the request to end and the kill.
GRACE = 3.0
# Characters of a child's output that are kept, and lines that a failure shows.
KEPT, SHOWN = 20_000, 25
# Exit status of a child that ended itself at its time limit, as in `timeout`.
TIME_IS_OVER = 124


class Ended(NamedTuple):
    """How a child ended.

    Attributes:
      status: exit status; None if the child was stopped at its time limit.
      said: the last lines of its output.
    """

    status: int | None
    said: str


def run(command: Sequence[str], seconds: float) -> Ended:
    """Runs a command, shows its output on stderr, and stops it after `seconds`.

    Args:
      command: program and arguments.
      seconds: time limit. The processes that the command has started are stopped too.
    """
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        start_new_session=True, env=_environment(),
    )  # fmt: skip
    said = _Said(process.stdout)
    try:
        status: int | None = process.wait(max(seconds, 0.0))
    except subprocess.TimeoutExpired:
        status = None
    finally:
        _stop(process)
    text = said.end()
    return Ended(None if status == TIME_IS_OVER else status, text)


def end_after(seconds: float) -> None:
    """Ends this process after `seconds`, also if its parent has ended."""
    timer = threading.Timer(seconds, os._exit, (TIME_IS_OVER,))
    timer.daemon = True
    timer.start()


def _environment() -> dict[str, str]:
    """Environment of a child: frequent checkpoints, unbuffered output."""
    usual = {"GENIDM_CHECKPOINT_SECONDS": "20", "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    return usual | os.environ


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Ends a child's process group: asks with SIGTERM, then kills."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
            if not _group_lives(process.pid):
                return


def _group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)  # signal 0 only tests whether the group exists
    except (ProcessLookupError, PermissionError):
        return False
    return True


class _Said:
    """The output of a process: copied to stderr at once, its last part kept."""

    def __init__(self, pipe: IO[bytes] | None):
        assert pipe
        self._pipe, self._text = pipe, ""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while part := os.read(self._pipe.fileno(), 1 << 16):
            text = part.decode(errors="replace")
            self._text = (self._text + text)[-KEPT:]
            sys.stderr.write(text)
            sys.stderr.flush()

    def end(self) -> str:
        """The last lines, without progress bars."""
        self._thread.join(GRACE)
        lines = [line.rstrip() for line in re.split(r"[\r\n]+", self._text)]
        return "\n".join([x for x in lines if x and not re.search(r"\d%\|", x)][-SHOWN:])


class Clock:
    """The time limit of a call.

    Args:
      minutes: how long the call may take.
    """

    def __init__(self, minutes: float):
        self._began = time.monotonic()
        # The last child must be stopped `GRACE` before the limit.
        self._end = self._began + max(60 * minutes - GRACE, 0.0)

    @property
    def left(self) -> float:
        """Seconds left for children."""
        return max(self._end - time.monotonic(), 0.0)

    @property
    def used(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._began
