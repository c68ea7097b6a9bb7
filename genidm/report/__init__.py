"""Tables and figures, made from the files of finished tests."""

from genidm.paper.protocol import TABLE1
from genidm.report.figures import (
    bearings,
    invariance,
    latent_sizes,
    learning_curves,
    paths,
    residuals,
    violins,
)
from genidm.report.held_out_figure import draw_held_out
from genidm.report.rows import Row, origin, results
from genidm.report.table import markdown, text
from genidm.report.waypoint_figure import draw_waypoint_runs

__all__ = [
    "TABLE1",
    "Row",
    "bearings",
    "draw_held_out",
    "draw_waypoint_runs",
    "invariance",
    "latent_sizes",
    "learning_curves",
    "markdown",
    "origin",
    "paths",
    "residuals",
    "results",
    "text",
    "violins",
]
