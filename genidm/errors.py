"""What a user can mend: said in one sentence, without a traceback."""

import re


class BadInput(Exception):
    """Input that cannot be used. Commands print it to stderr and exit with status 2."""


def sentence(error: BaseException) -> str | None:
    """What a user can mend of an error that jax has wrapped in one of its own; None if nothing.

    A program that calls the host (`jax.pure_callback`) gives an error of jax, with the BadInput
    that was raised there as a line of its text.
    """
    text = str(error)
    if found := re.search(rf"^(?:\S+\.)?{BadInput.__name__}: (.+)$", text, re.MULTILINE):
        return found[1]
    if "RESOURCE_EXHAUSTED" in text:
        return f"not enough memory: {text.splitlines()[0]:.200}"
    return None
