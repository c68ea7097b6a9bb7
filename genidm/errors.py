"""Errors that the user can correct: reported in one sentence, without a traceback."""

import re


class BadInput(Exception):
    """Invalid input. Commands print the message to stderr and exit with status 2."""


def sentence(error: BaseException) -> str | None:
    """Message for a jax error that wraps BadInput or reports lack of memory; None for others.

    If a host callback (`jax.pure_callback`) raises BadInput, jax raises its own error, whose
    text contains the BadInput in one line.
    """
    text = str(error)
    if found := re.search(rf"^(?:\S+\.)?{BadInput.__name__}: (.+)$", text, re.MULTILINE):
        return found[1]
    if "RESOURCE_EXHAUSTED" in text:
        return f"not enough memory: {text.splitlines()[0]:.200}"
    return None
