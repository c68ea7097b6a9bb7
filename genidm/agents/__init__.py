"""Agents that collect experience, built from parts of `brax.training`."""

import genidm.quiet  # noqa: F401  must come before Brax imports MJX
