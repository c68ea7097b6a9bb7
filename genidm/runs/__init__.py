"""Runs of methods on robots: settings, scales, stages, reports and the command line."""
