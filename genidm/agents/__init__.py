"""Agents that collect experience, composed from the parts of `brax.training`."""
