"""Agents that collect experience, composed from the parts of `brax.training`."""

import genidm.quiet  # noqa: F401  before Brax imports MJX
