"""Trees of arrays: names of their leaves, and differences between two trees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from genidm.errors import BadInput


def named(tree: Any) -> dict[str, Any]:
    """Path → leaf; dicts, dataclasses and tuples have the same paths.

    Raises:
      BadInput: two leaves have the same path.
    """
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    leaves = {jax.tree_util.keystr(p, simple=True, separator="/") or "tree": x for p, x in pairs}
    if len(leaves) < len(pairs):
        raise BadInput("two leaves of a tree have the same name")
    return leaves


def kinds(tree: Any) -> dict[str, str]:
    """Name → dtype and shape of each leaf: an array, a `jax.ShapeDtypeStruct` or a number."""
    return {name: _kind(x) for name, x in named(tree).items()}


def _kind(x: Any) -> str:
    """Dtype and shape; for a scalar no bit width, because jit converts Python numbers."""
    shape, dtype = np.shape(x), str(x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype)
    return f"{dtype}{list(shape)}" if shape else dtype.rstrip("0123456789")


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, str, str] | None:
    """First name whose `kinds` differ: (name, kind there, kind here); None if all are equal."""
    for name in sorted(there.keys() | here.keys()):
        both = there.get(name, "absent"), here.get(name, "absent")
        if both[0] != both[1]:
            return name, *both
    return None


def not_finite(tree: Any) -> str | None:
    """Name of the first leaf that holds NaN or infinity; None if all leaves are finite."""
    for name, x in named(tree).items():
        dtype = x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype
        if jnp.issubdtype(dtype, jnp.inexact) and not np.isfinite(np.asarray(x)).all():
            return name
    return None
