"""Trees of arrays: their leaves by name, and in what two trees differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from genidm.errors import BadInput


def named(tree: Any) -> dict[str, Any]:
    """Leaves by their paths, which do not tell a dict from a dataclass or a tuple.

    Raises:
      BadInput: two leaves have one name.
    """
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    leaves = {jax.tree_util.keystr(p, simple=True, separator="/") or "tree": x for p, x in pairs}
    if len(leaves) < len(pairs):
        raise BadInput("two leaves of a tree have one name")
    return leaves


def kinds(tree: Any) -> dict[str, str]:
    """Name → dtype and shape of each leaf: an array, a `jax.ShapeDtypeStruct` or a number."""
    return {name: _kind(x) for name, x in named(tree).items()}


def _kind(x: Any) -> str:
    """Dtype and shape; of one number only its kind, as jit makes arrays of Python's."""
    shape, dtype = np.shape(x), str(x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype)
    return f"{dtype}{list(shape)}" if shape else dtype.rstrip("0123456789")


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, str, str] | None:
    """The first name whose `kinds` differ: (name, kind there, kind here); None if there is none."""
    for name in sorted(there.keys() | here.keys()):
        both = there.get(name, "absent"), here.get(name, "absent")
        if both[0] != both[1]:
            return name, *both
    return None


def not_finite(tree: Any) -> str | None:
    """The name of the first leaf that holds NaN or infinity; None if there is none."""
    for name, x in named(tree).items():
        dtype = x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype
        if jnp.issubdtype(dtype, jnp.inexact) and not np.isfinite(np.asarray(x)).all():
            return name
    return None
