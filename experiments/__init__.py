"""The paper's experiments, one small file each: only what differs (Table 2)."""

from __future__ import annotations

import sys
from types import TracebackType


def _stopped(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
    """Ctrl-C while a command is still read in: a sentence, and the exit status of a shell."""
    if not issubclass(kind, KeyboardInterrupt):
        return sys.__excepthook__(kind, error, where)
    print("stopped: nothing had begun", file=sys.stderr)
    sys.exit(130)


# While `python -m experiments.NAME` imports, before the module itself has begun.
if sys.argv and sys.argv[0] == "-m":
    sys.excepthook = _stopped
