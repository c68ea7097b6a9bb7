"""What a user can mend: said in one sentence, without a traceback."""


class BadInput(Exception):
    """Input that cannot be used. Commands print it to stderr and exit with status 2."""
