"""A stand-in for kill -9 that a test can catch."""

from __future__ import annotations

from collections.abc import Callable

from genidm.progress import Progress


class Killed(BaseException):
    """Stands for kill -9."""


def dies_at(call: int) -> Callable:
    """Progress.advance, up to a call that never returns."""
    advance, calls = Progress.advance, []

    def dying(self, *args, **kwargs):
        calls.append(args)
        if len(calls) == call:
            raise Killed
        advance(self, *args, **kwargs)

    return dying
