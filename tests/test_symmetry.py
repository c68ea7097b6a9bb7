"""Every kind of field transforms as the world does: as properties, and against scipy."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from genidm import symmetry
from genidm.errors import BadInput
from genidm.symmetry import Field, Layout

LANES = 64
FIELDS = [
    symmetry.invariant("height", 2, "m"),
    symmetry.vector("velocity", "m/s"),
    symmetry.body_pseudovector("spin"),
    symmetry.quaternion("orientation"),
    symmetry.joints("joints", [1, 0, 2], [-1, -1, 1], "rad"),
    symmetry.wrenches("contact", [0, 2, 1]),
]
EULER = symmetry.euler("angles")
OTHERS = [symmetry.heading_vector("velocity ahead", "m/s"), EULER]
each_field = pytest.mark.parametrize("field", FIELDS + OTHERS, ids=lambda f: f.name)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def sample(rng: np.random.Generator, field: Field) -> jnp.ndarray:
    x = rng.normal(size=(LANES, field.size))
    if field.kind == "quaternion":
        return canonical(x / np.linalg.norm(x, axis=-1, keepdims=True))
    if field is EULER:
        return symmetry.euler_of(sample(rng, FIELDS[3]))
    return jnp.asarray(x)


def angles(rng: np.random.Generator) -> jnp.ndarray:
    return jnp.asarray(rng.uniform(-4, 4, LANES))


def canonical(q: np.ndarray) -> jnp.ndarray:
    return jnp.asarray(np.where(q[:, :1] < 0, -q, q))


def rotation(q: jnp.ndarray) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def about_z(yaw: jnp.ndarray) -> Rotation:
    return Rotation.from_euler("z", np.asarray(yaw)[:, None])


def same(field: Field, x: jnp.ndarray, y: jnp.ndarray) -> bool:
    if field.kind == "quaternion":  # where w is nearly 0, rounding may choose the other sign
        y = y * jnp.sign(jnp.sum(x * y, axis=-1, keepdims=True))
    if field is EULER:  # where the yaw is nearly π, rounding may choose −π
        y = x + symmetry.wrap(y - x)
    return np.allclose(x, y, atol=1e-5)


# ── properties ──────────────────────────────────────────────────────────────────────────────


@each_field
@pytest.mark.usefixtures("strict_ranks")
def test_turns_add_up(field: Field, rng: np.random.Generator) -> None:
    x, a, b = sample(rng, field), angles(rng), angles(rng)
    assert same(field, field.rotate(field.rotate(x, a), b), field.rotate(x, a + b))


@each_field
@pytest.mark.usefixtures("strict_ranks")
def test_a_turn_by_nothing_changes_nothing(field: Field, rng: np.random.Generator) -> None:
    x = sample(rng, field)
    turned = field.rotate(x, jnp.zeros(LANES))
    assert same(field, turned, x) if field is EULER else np.array_equal(turned, x)


@each_field
def test_two_reflections_cancel(field: Field, rng: np.random.Generator) -> None:
    x = sample(rng, field)
    assert np.array_equal(field.mirror(field.mirror(x)), x)


@each_field
def test_a_reflection_reverses_turns(field: Field, rng: np.random.Generator) -> None:
    x, yaw = sample(rng, field), angles(rng)
    assert same(field, field.mirror(field.rotate(x, yaw)), field.rotate(field.mirror(x), -yaw))


def test_what_is_seen_along_the_heading_mirrors_as_the_world_does(rng: np.random.Generator) -> None:
    """x ahead, y to the left: seen along the mirrored heading, y alone changes its sign."""
    in_world, yaw = jnp.asarray(rng.normal(size=(LANES, 3))), angles(rng)
    field = symmetry.heading_vector("velocity")
    seen = symmetry.rotate_vector(in_world, -yaw)
    across = symmetry.rotate_vector(in_world * np.asarray([1, -1, 1]), yaw)
    assert np.allclose(field.mirror(seen), across, atol=1e-5)


@each_field
def test_a_batch_is_its_lanes(field: Field, rng: np.random.Generator) -> None:
    x, yaw = sample(rng, field), angles(rng)
    one = [(field.rotate(x[i], yaw[i]), field.mirror(x[i])) for i in range(3)]
    batch = field.rotate(x, yaw), field.mirror(x)
    for i, (turned, mirrored) in enumerate(one):
        assert np.allclose(turned, batch[0][i], atol=1e-6) and np.array_equal(mirrored, batch[1][i])


@each_field
def test_kinds_say_whether_a_turn_is_seen(field: Field, rng: np.random.Generator) -> None:
    x = sample(rng, field)
    moved = not np.allclose(field.rotate(x, jnp.ones(LANES)), x)
    assert moved == (field.kind in ("vector", "quaternion", "wrenches", "Euler angles"))


# ── scipy ───────────────────────────────────────────────────────────────────────────────────


def test_vectors_turn_as_scipy_turns_them(rng: np.random.Generator) -> None:
    v, yaw = rng.normal(size=(LANES, 3)), angles(rng)
    expected = about_z(yaw).apply(v)
    assert np.allclose(symmetry.rotate_vector(jnp.asarray(v), yaw), expected, atol=1e-5)


def test_one_vector_turns_by_many_yaws(rng: np.random.Generator) -> None:
    v, yaw = rng.normal(size=3), angles(rng)
    expected = about_z(yaw).apply(v)
    assert np.allclose(symmetry.rotate_vector(jnp.asarray(v), yaw), expected, atol=1e-5)


def test_quaternions_turn_as_scipy_turns_them(rng: np.random.Generator) -> None:
    q, yaw = sample(rng, FIELDS[3]), angles(rng)
    expected = (about_z(yaw) * rotation(q)).as_quat(scalar_first=True)
    assert np.allclose(symmetry.rotate_quaternion(q, yaw), canonical(expected), atol=1e-5)


def test_quaternions_are_given_with_positive_w(rng: np.random.Generator) -> None:
    q = sample(rng, FIELDS[3])
    assert np.array_equal(symmetry.canonical_quaternion(-q), q) and np.array_equal(
        symmetry.canonical_quaternion(q), q
    )
    assert (symmetry.rotate_quaternion(-q, angles(rng))[:, 0] >= 0).all()


def test_heading_is_where_the_body_points(rng: np.random.Generator) -> None:
    q = sample(rng, FIELDS[3])
    x, y, _ = rotation(q).apply([1.0, 0.0, 0.0]).T
    assert np.allclose(symmetry.yaw_of(q), np.arctan2(y, x), atol=1e-5)


def test_heading_turns_with_the_world(rng: np.random.Generator) -> None:
    q, yaw = sample(rng, FIELDS[3]), angles(rng)
    change = symmetry.yaw_of(symmetry.rotate_quaternion(q, yaw)) - symmetry.yaw_of(q)
    assert np.allclose(symmetry.wrap(change - yaw + 1.0), 1.0, atol=1e-4)
    assert np.allclose(symmetry.yaw_of(FIELDS[3].mirror(q)), -symmetry.yaw_of(q), atol=1e-6)


def test_quaternions_mirror_as_rotation_matrices_do(rng: np.random.Generator) -> None:
    q, reflection = sample(rng, FIELDS[3]), np.diag([1.0, -1.0, 1.0])
    expected = reflection @ rotation(q).as_matrix() @ reflection
    assert np.allclose(rotation(FIELDS[3].mirror(q)).as_matrix(), expected, atol=1e-5)


def test_spins_mirror_as_rotation_matrices_do(rng: np.random.Generator) -> None:
    spin, reflection = rng.normal(size=(LANES, 3)), np.diag([1.0, -1.0, 1.0])
    expected = reflection @ Rotation.from_rotvec(spin).as_matrix() @ reflection
    mirrored = np.asarray(FIELDS[2].mirror(jnp.asarray(spin)))
    assert np.allclose(Rotation.from_rotvec(mirrored).as_matrix(), expected, atol=1e-5)


def test_torques_transform_as_arm_times_force(rng: np.random.Generator) -> None:
    arm, force, yaw = rng.normal(size=(LANES, 3, 3)), rng.normal(size=(LANES, 3, 3)), angles(rng)

    def wrench(arm: np.ndarray, force: np.ndarray) -> jnp.ndarray:
        return jnp.asarray(np.concatenate([np.cross(arm, force), force], -1).reshape(LANES, 18))

    def turned(v: np.ndarray) -> np.ndarray:
        return np.einsum("bij,bnj->bni", about_z(yaw).as_matrix(), v)

    def mirrored(v: np.ndarray) -> np.ndarray:  # the bodies swap places, too
        return v[:, [0, 2, 1]] * [1, -1, 1]

    contact = FIELDS[5]
    expected = wrench(turned(arm), turned(force))
    assert np.allclose(contact.rotate(wrench(arm, force), yaw), expected, atol=1e-5)
    expected = wrench(mirrored(arm), mirrored(force))
    assert np.allclose(contact.mirror(wrench(arm, force)), expected, atol=1e-5)


def test_a_quarter_turn_of_the_axes_is_scipys(rng: np.random.Generator) -> None:
    quarter = Rotation.from_euler("z", 90, degrees=True)
    v = rng.normal(size=(20, 3))
    np.testing.assert_allclose(symmetry.turn_axes(v), quarter.inv().apply(v), atol=1e-6)
    q = Rotation.random(20, random_state=0)
    turned = np.roll(symmetry.turn_quaternion(np.roll(q.as_quat(), 1, axis=-1)), -1, axis=-1)
    apart = (q * quarter).inv() * Rotation.from_quat(turned)
    assert apart.magnitude().max() < 1e-6


def test_four_quarter_turns_of_a_body_are_none(rng: np.random.Generator) -> None:
    legs = symmetry.joints("legs", [3, 2, 1, 0], [1] * 4, "rad", ([1, 2, 3, 0], [1, -1, 1, -1]))
    layout = Layout((symmetry.quaternion("orientation"), symmetry.body_pseudovector("spin"), legs))
    q = Rotation.random(9, random_state=1).as_quat(canonical=True)
    x = np.concatenate([np.roll(q, 1, axis=-1), rng.normal(size=(9, 7))], axis=-1)
    quarters = np.arange(9) - 4
    turned = layout.turn_body_by(jnp.asarray(x, jnp.float32), jnp.asarray(quarters))
    for n, row in zip(quarters, np.asarray(turned), strict=True):
        expected = jnp.asarray(x[n + 4], jnp.float32)
        for _ in range(n % 4):
            expected = layout.turn_body(expected)
        np.testing.assert_allclose(row, expected, atol=1e-6)
    np.testing.assert_allclose(turned[0], x[0], atol=1e-6)  # −4 quarters


def test_the_nearest_side_is_within_45_degrees() -> None:
    heading = jnp.linspace(-np.pi, np.pi, 101)
    for angle in (-2.5, 0.0, 1.3):
        quarters = symmetry.quarters_to(jnp.float32(angle), heading)
        off = symmetry.wrap(heading + quarters * np.pi / 2 - angle)
        assert jnp.abs(off).max() <= np.pi / 4 + 1e-5
    assert symmetry.quarters_to(jnp.float32(0.1), jnp.float32(0.0)) == 0


def test_a_body_without_quarter_turns_says_so() -> None:
    layout = Layout((symmetry.joints("arms", [1, 0], [1, 1], "rad"),))
    assert not layout.can_turn
    with pytest.raises(ValueError, match="quarter turn"):
        layout.turn_body(jnp.zeros(2))


def test_joints_go_to_the_joint_across() -> None:
    assert FIELDS[4].mirror(jnp.array([1.0, 2.0, 3.0])).tolist() == [-2.0, -1.0, 3.0]


@pytest.mark.parametrize("order", [[1, 2], [0, 0], [1, 2, 0], [-1, 0]])
def test_what_is_across_is_across_from_it(order: list[int]) -> None:
    for make in (lambda: symmetry.joints("legs", order, [1] * len(order), "rad"),
                 lambda: symmetry.wrenches("feet", order)):  # fmt: skip
        with pytest.raises(BadInput, match="its own inverse"):
            make()


def test_joints_have_as_many_signs() -> None:
    with pytest.raises(BadInput, match="2 joints, but 1 signs"):
        symmetry.joints("legs", [1, 0], [1], "rad")


def test_angles_are_those_of_scipy(rng: np.random.Generator) -> None:
    q, yaw = sample(rng, FIELDS[3]), angles(rng)
    expected = rotation(q).as_euler("ZYX")[:, ::-1]
    assert np.allclose(symmetry.euler_of(q), expected, atol=1e-4)
    turned = symmetry.euler_of(symmetry.rotate_quaternion(q, yaw))
    assert same(EULER, EULER.rotate(symmetry.euler_of(q), yaw), turned)
    mirrored = symmetry.euler_of(FIELDS[3].mirror(q))
    assert same(EULER, EULER.mirror(symmetry.euler_of(q)), mirrored)


def test_wrap_brings_angles_into_one_turn() -> None:
    angle = jnp.linspace(-20, 20, 101)
    wrapped = symmetry.wrap(angle)
    assert (wrapped >= -jnp.pi).all() and (wrapped < jnp.pi).all()
    turns = (angle - wrapped) / (2 * jnp.pi)
    assert np.allclose(turns, np.round(turns), atol=1e-5)


def test_horizontal_leaves_height_out() -> None:
    assert symmetry.horizontal_norm(jnp.array([3.0, 4.0, 100.0])) == 5.0


# ── layouts ─────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def layout() -> Layout:
    return Layout(tuple(FIELDS))


def test_a_layout_is_its_fields(layout: Layout, rng: np.random.Generator) -> None:
    parts, yaw = [sample(rng, f) for f in FIELDS], angles(rng)
    x = jnp.concatenate(parts, axis=-1)
    turned, mirrored = layout.rotate(x, yaw), layout.mirror(x)
    assert layout.size == x.shape[-1] == 33
    for field, part in zip(FIELDS, parts, strict=True):
        assert np.array_equal(layout.part(x, field.name), part)
        assert np.array_equal(layout.part(turned, field.name), field.rotate(part, yaw))
        assert np.array_equal(layout.part(mirrored, field.name), field.mirror(part))
    assert np.array_equal(layout.yaw(x), symmetry.yaw_of(parts[3]))


def test_a_layout_describes_itself(layout: Layout) -> None:
    rows = layout.describe().splitlines()[2:]
    assert len(rows) == len(FIELDS)
    assert rows[0] == "| 0–1 | height | m | invariant |"
    assert rows[-1] == "| 15–32 | contact | N·m, N | wrenches |"


def test_a_layout_refuses_names_given_twice() -> None:
    with pytest.raises(ValueError, match="the same name"):
        Layout((symmetry.vector("v"), symmetry.invariant("v")))


def test_a_layout_refuses_other_sizes(layout: Layout) -> None:
    for use in (layout.mirror, layout.yaw, lambda x: layout.rotate(x, 0.0)):
        with pytest.raises(ValueError, match="expected 33 numbers, got 32"):
            use(jnp.zeros((LANES, 32)))


def test_a_layout_without_a_heading_says_so() -> None:
    with pytest.raises(ValueError, match="holds a heading"):
        Layout((symmetry.vector("v"),)).yaw(jnp.zeros(3))
