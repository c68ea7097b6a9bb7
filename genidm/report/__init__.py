"""Tables and figures from episodes: everything here derives from what the evaluation left."""

from genidm.report.figures import bearings, learning_curves, paths, residuals, violins
from genidm.report.paper import TABLE1
from genidm.report.table import Row, markdown, results, text

__all__ = [
    "TABLE1",
    "Row",
    "bearings",
    "learning_curves",
    "markdown",
    "paths",
    "residuals",
    "results",
    "text",
    "violins",
]
