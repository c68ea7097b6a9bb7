"""genidm: goal-directed locomotion learned from experience that was never goal-directed."""

from genidm.devices import configure as _configure
from genidm.quiet import import_mjx as _import_mjx

_configure()
_import_mjx()
