"""The paper's experiments, one small file each (Table 2)."""

from __future__ import annotations

import sys
from types import TracebackType


def _stopped(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
    """Reports Ctrl-C during imports in one sentence, with a shell's exit status for SIGINT."""
    if not issubclass(kind, KeyboardInterrupt):
        return sys.__excepthook__(kind, error, where)
    print("stopped before the command began", file=sys.stderr)
    sys.exit(130)


# argv[0] is "-m" while `python -m experiments.NAME` imports, before the module itself runs.
if sys.argv and sys.argv[0] == "-m":
    sys.excepthook = _stopped
