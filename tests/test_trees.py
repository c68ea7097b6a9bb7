"""Leaves have names, and a difference is told by them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from genidm import trees
from genidm.errors import BadInput

TREE = {"a": (np.zeros((2, 3), np.int8), 1.5), "key": jax.random.key(0), "b": {"c": jnp.ones(4)}}


def test_leaves_are_named_by_their_paths() -> None:
    assert list(trees.named(TREE)) == ["a/0", "a/1", "b/c", "key"]
    assert trees.named(3) == {"tree": 3}
    with pytest.raises(BadInput, match="same name"):
        trees.named({"a": {"b": 1}, "a/b": 2})


def test_kinds_are_dtypes_and_shapes_and_abstract_ones_are_the_same() -> None:
    expected = {"a/0": "int8[2, 3]", "a/1": "float", "b/c": "float32[4]", "key": "key<fry>"}
    assert trees.kinds(TREE) == expected
    assert trees.kinds(jax.eval_shape(lambda: TREE)) == expected


@pytest.mark.parametrize(
    ("changed", "difference"),
    [
        ({}, None),
        ({"b": {"c": jnp.ones(5)}}, ("b/c", "float32[4]", "float32[5]")),
        ({"b": {"d": jnp.ones(4)}}, ("b/c", "float32[4]", "absent")),
        ({"b": {"c": np.ones(4)}}, ("b/c", "float32[4]", "float64[4]")),
        ({"z": 1}, ("z", "absent", "int")),
    ],
)
def test_the_first_difference_is_told(changed: dict, difference: tuple | None) -> None:
    assert trees.difference(trees.kinds(TREE), trees.kinds({**TREE, **changed})) == difference


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16, jnp.bfloat16, np.complex64])
def test_the_first_leaf_that_is_not_finite_is_found(dtype: type) -> None:
    assert trees.not_finite(TREE) is None
    for wrong in (np.nan, np.inf, -np.inf):
        broken = np.ones((3, 2), dtype)
        broken[1, 1] = wrong
        assert trees.not_finite({**TREE, "b": {"c": broken}}) == "b/c"
        assert trees.not_finite((1, wrong)) == "1"
