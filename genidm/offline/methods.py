"""The rows of the extended table: today's offline goal-conditioned baselines on our records.

A row NAME learns from the same part of the record as RL, and NAME_G from what GE learns from: the
same part as GE and 𝒢 of it.
"""

from __future__ import annotations

import dataclasses

from genidm.errors import BadInput
from genidm.offline.crl import CRL
from genidm.offline.gcbc import GCBC
from genidm.offline.gcivl import GCIVL
from genidm.offline.hiql import HIQL
from genidm.offline.learner import Learner
from genidm.paper import methods
from genidm.paper.methods import FromRecord


@dataclasses.dataclass(frozen=True)
class OfflineGoalConditioned(FromRecord):
    """An offline goal-conditioned baseline; not in the paper.

    Attributes:
      learner: networks, losses, goals.
    """

    learner: Learner


AnyMethod = methods.AnyMethod | OfflineGoalConditioned

LEARNERS: dict[str, Learner] = {"GCBC": GCBC(), "GCIVL": GCIVL(), "HIQL": HIQL(), "CRL": CRL()}
"""Name of a row → its learner."""

# Suffix of a row's name → the method of the paper whose record the row learns from.
_RECORDS = {"": "RL", "_G": "GE"}

EXTENDED = tuple(name + suffix for name in LEARNERS for suffix in _RECORDS)
"""The rows of the extended table, in their order."""


def by_name(name: str, robot: str = "ant") -> AnyMethod:
    """Find a method of Table 1 or of the extended table, with its settings for a robot.

    Raises:
      BadInput: no method has this name.
    """
    for suffix, source in _RECORDS.items():
        learner = LEARNERS.get(name.removesuffix(suffix))
        if learner and name in EXTENDED and name.endswith(suffix):
            record = methods.by_name(source, robot)
            assert isinstance(record, FromRecord)
            fields = {f.name: getattr(record, f.name) for f in dataclasses.fields(FromRecord)}
            return OfflineGoalConditioned(**fields | {"name": name}, learner=learner)
    try:
        return methods.by_name(name, robot)
    except BadInput as error:
        raise BadInput(f"{error}, {', '.join(EXTENDED)}") from None
