"""One Minitaur in PyBullet: the model of `pybullet_envs`, without gym.

As a script, this file is a worker process that steps the robots it receives (`serve`). So it does
not import genidm: a worker starts in half a second, without jax.

Coordinates are those of Bullet's world: z up, metres, radians. Joints have the order of the
motors: by leg, front left, back left, front right, back right, and in each leg L before R. Their
signs are such that equal angles mean symmetric legs.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import inspect
import json
import math
import os
import select
import signal
import sys
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np

# ── constants of pybullet_envs (bullet/minitaur.py, motor.py, minitaur_gym_env.py) ──────────

URDF = "quadruped/minitaur.urdf"  # in pybullet_data
LEGS = ("front_left", "back_left", "front_right", "back_right")
MOTORS = [f"motor_{leg}{side}_joint" for leg in LEGS for side in "LR"]
KNEES = [f"knee_{leg}{side}_link" for leg in LEGS for side in "LR"]
DIRECTION = np.repeat([-1.0, 1.0], 4)

SUBSTEP = 0.002  # s, one physics step; each computes the motors' torques anew
SUBSTEPS = 5  # physics steps per control step
GRAVITY = -10.0  # m/s²
START_HEIGHT = 0.2  # m
SETTLING = 100  # physics steps of a reset in which every motor holds MOTOR_START
MOTOR_START, KNEE_START = math.pi / 2, -2.1834  # rad
# Metres; the point that joins the two shins of a leg, in the frame of each shin.
JOINED_RIGHT, JOINED_LEFT = (0.0, 0.005, 0.2), (0.0, 0.01, 0.2)

KP, KD = 1.0, 0.02  # share of full voltage per rad, per rad/s
VOLTAGE, VOLTAGE_CLIP = 16.0, 50.0  # V
RESISTANCE = 0.186  # Ω
TORQUE_CONSTANT = 0.0954  # N·m/A, and V·s/rad
OBSERVED_LIMIT = 5.7  # N·m, limit of the observed torque
CURRENTS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)  # A
TORQUES = (0.0, 1.0, 1.9, 2.45, 3.0, 3.25, 3.5)  # N·m, at these currents
# Overheating: a motor above HOT N·m for more than PATIENT physics steps (1 s) is off for good.
HOT, PATIENT = 2.45, 1.0 / SUBSTEP

SWING = np.array([1, -1, 1, -1, -1, 1, -1, 1])  # sign of each motor's part in its leg's swing
EXTENSION_OFFSET = 1.5  # of the leg model: legs are half bent at action 0
FALLEN_UP, FALLEN_HEIGHT = 0.85, 0.13  # cosine of the tilt; m
ENERGY_WEIGHT = 0.005  # metres of reward per joule

# The simulation has failed if a number of its state is beyond this bound, or not finite.
ABSURD = 1e4
# Metres; high enough above the floor that a robot there has no contacts.
ALOFT = 50.0

ROW = {
    "position": 3, "orientation": 4, "angles": 16, "velocity": 3, "spin": 3, "rates": 16,
    "heat": 8, "torque": 8,
}  # fmt: skip
"""Everything that a step depends on: name → count of its numbers in a row `[61]`.

Base position (m), orientation (w, x, y, z), joint angles (rad, motors before knees); base
velocity (m/s) and spin (rad/s) in the world frame, joint velocities (rad/s); for each motor the
number of successive physics steps above HOT, and its last observed torque (N·m).
"""
WIDTH = sum(ROW.values())
ACTIONS = 8

# Joint angles at the start, motors before knees.
REST = np.repeat([MOTOR_START, KNEE_START], 8)


@dataclasses.dataclass(frozen=True)
class Solver:
    """Settings of Bullet, chosen by measurement (docs/physics.md).

    Attributes:
      iterations: iterations of the constraint solver; pybullet_envs has 60, too.
      self_collision: whether legs collide with each other and the body, as in pybullet_envs.
      cone: whether friction cones are round, as in pybullet_envs. Without round cones, a rotated
        replay stays close to the record for longer.
    """

    iterations: int = 60
    self_collision: bool = False
    cone: bool = False


def parts(row: np.ndarray) -> dict[str, np.ndarray]:
    """Splits a row `[61]` into its parts, by the names in ROW."""
    return dict(zip(ROW, np.split(row, np.cumsum([*ROW.values()])[:-1]), strict=True))


def motor_angles(action: np.ndarray) -> np.ndarray:
    """The leg model: motor angles `[8]`, radians, for an action `[8]` in [−1, 1].

    The first half of the action is the swing of each leg, ±45° at ±1; the second half is its
    retraction, 45° of both motors at 1 (pybullet_envs calls it extension).
    """
    swing, extension = np.repeat(np.clip(action, -1.0, 1.0).reshape(2, 4), 2, axis=1)
    return math.pi + math.pi / 4 * (SWING * swing - extension - EXTENSION_OFFSET)


def motor_torques(
    command: np.ndarray, angle: np.ndarray, rate: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The DC motors under position control: torques applied and observed, each `[8]`, N·m.

    Args:
      command: desired motor angles `[8]`, rad.
      angle: motor angles `[8]`, rad.
      rate: motor velocities `[8]`, rad/s.
    """
    duty = np.clip(-KP * (angle - command) - KD * rate, -1.0, 1.0)
    observed = TORQUE_CONSTANT * (duty * VOLTAGE / RESISTANCE)
    net = np.clip(duty * VOLTAGE - TORQUE_CONSTANT * rate, -VOLTAGE_CLIP, VOLTAGE_CLIP)
    current = net / RESISTANCE
    given = np.sign(current) * np.interp(np.abs(current), CURRENTS, TORQUES)
    return given, np.clip(observed, -OBSERVED_LIMIT, OBSERVED_LIMIT)


def has_fallen(orientation: Any, height: Any) -> Any:
    """Whether robots with orientations `[..., 4]` and heights `[...]` in metres have fallen."""
    x, y = orientation[..., 1], orientation[..., 2]
    return (1 - 2 * (x * x + y * y) < FALLEN_UP) | (height < FALLEN_HEIGHT)


def charge(torque: Any, rate: Any) -> Any:
    """Energy cost `[...]` of a control step, in metres of reward, as in pybullet_envs.

    0.005 |τ·q̇| Δt, where τ, q̇ and Δt are those of the last of the five physics steps.

    Args:
      torque: observed torques `[..., 8]`, N·m.
      rate: motor velocities `[..., 8]`, rad/s.
    """
    return ENERGY_WEIGHT * abs((torque * rate).sum(-1)) * SUBSTEP


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Discards stdout and stderr of the process: PyBullet prints to both from C."""
    flush = ctypes.CDLL(None).fflush
    flush(None)
    kept, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        yield
        flush(None)
    finally:
        for stream, was in zip((1, 2), kept, strict=True):
            os.dup2(was, stream)
        for file in (*kept, nowhere):
            os.close(file)


class Client:
    """PyBullet's functions, bound to one physics server; a process may have several."""

    def __init__(self, pybullet: Any, server: int):
        self._pybullet, self._server = pybullet, server

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._pybullet, name)
        if inspect.isbuiltin(found):
            found = functools.partial(found, physicsClientId=self._server)
        setattr(self, name, found)
        return found


class Simulation:
    """A Minitaur on a plane, with a state that `step` advances.

    `reset` loads the simulation anew; `set_state` sets any state.

    Args:
      solver: settings of Bullet.

    Raises:
      ImportError: PyBullet is not installed.
    """

    def __init__(self, solver: Solver | None = None):
        with silence():
            import pybullet

            server = pybullet.connect(pybullet.DIRECT)
        self.solver = solver or Solver()
        self.bullet: Any = Client(pybullet, server)
        self._end = weakref.finalize(self, pybullet.disconnect, server)
        self.reset()

    def reset(self, yaw: float = 0.0) -> None:
        """Loads the robot at `yaw` (rad) and lets it settle on the floor, as in pybullet_envs."""
        self.bullet.resetSimulation()
        self._load(yaw)
        self.heat, self.torque = np.zeros(8), np.zeros(8)
        for _ in range(SETTLING):
            self._drive(np.full(8, MOTOR_START))

    def _load(self, yaw: float) -> None:
        import pybullet_data

        bullet, solver = self.bullet, self.solver
        bullet.setPhysicsEngineParameter(
            numSolverIterations=solver.iterations, enableConeFriction=int(solver.cone),
            # Orders contacts by links; else their order depends on earlier steps.
            deterministicOverlappingPairs=1,
        )  # fmt: skip
        bullet.setTimeStep(SUBSTEP)
        bullet.setGravity(0, 0, GRAVITY)
        bullet.setAdditionalSearchPath(pybullet_data.getDataPath())
        bullet.loadURDF("plane.urdf")
        flags = bullet.URDF_USE_SELF_COLLISION if solver.self_collision else 0
        upright = bullet.getQuaternionFromEuler([0, 0, yaw])
        self.body = bullet.loadURDF(URDF, [0, 0, START_HEIGHT], upright, flags=flags)
        self._find_joints()
        self._set_joints(REST, np.zeros(16))
        self._join_knees()

    def _find_joints(self) -> None:
        names = [
            self.bullet.getJointInfo(self.body, i)[1].decode()
            for i in range(self.bullet.getNumJoints(self.body))
        ]
        self.motors, self.knees = ([names.index(x) for x in part] for part in (MOTORS, KNEES))

    def _join_knees(self) -> None:
        bullet, body = self.bullet, self.body
        for left, right in zip(self.knees[0::2], self.knees[1::2], strict=True):
            bullet.createConstraint(
                body, right, body, left, bullet.JOINT_POINT2POINT, [0, 0, 0],
                JOINED_RIGHT, JOINED_LEFT,
            )  # fmt: skip
        # Switches off Bullet's default motors, which brake every joint.
        bullet.setJointMotorControlArray(
            body, self.motors + self.knees, bullet.VELOCITY_CONTROL,
            targetVelocities=[0] * 16, forces=[0] * 16,
        )  # fmt: skip

    def _set_joints(self, angles: np.ndarray, rates: np.ndarray) -> None:
        """Sets angles (rad) and rates (rad/s), each `[16]`, motors before knees."""
        q, v = (x * np.tile(DIRECTION, 2) for x in (angles, rates))
        self.bullet.resetJointStatesMultiDof(
            self.body, self.motors + self.knees, q[:, None].tolist(), v[:, None].tolist()
        )

    def set_state(self, row: np.ndarray) -> None:
        """Sets the state to `row [61]`.

        All later steps depend on the row alone, to the last bit. Bullet keeps contacts from step
        to step, so the robot is first moved into the air, where it loses its contacts.
        """
        x = parts(row.astype(np.float64))
        self._set_joints(REST, np.zeros(16))
        self.bullet.resetBasePositionAndOrientation(self.body, [0, 0, ALOFT], [0, 0, 0, 1])
        self.bullet.performCollisionDetection()
        self._set_joints(x["angles"], x["rates"])
        w, *xyz = x["orientation"] / np.linalg.norm(x["orientation"])
        self.bullet.resetBasePositionAndOrientation(self.body, x["position"], [*xyz, w])
        self.bullet.resetBaseVelocity(self.body, x["velocity"], x["spin"])
        self.heat, self.torque = x["heat"], x["torque"]

    def read(self) -> np.ndarray:
        """The state as a row `[61]`, in float64."""
        position, (x, y, z, w) = self.bullet.getBasePositionAndOrientation(self.body)
        velocity, spin = self.bullet.getBaseVelocity(self.body)
        angles, rates = self._joints(self.motors + self.knees) * np.tile(DIRECTION, 2)
        return np.concatenate(
            [position, [w, x, y, z], angles, velocity, spin, rates, self.heat, self.torque]
        )

    def _joints(self, joints: list[int]) -> np.ndarray:
        """Angles and rates `[2, joints]`, with Bullet's signs."""
        states = self.bullet.getJointStates(self.body, joints)
        return np.array([state[:2] for state in states]).T

    def step(self, action: np.ndarray) -> None:
        """Makes one control step under an action `[8]`."""
        command = motor_angles(action)
        for _ in range(SUBSTEPS):
            self._drive(command)

    def _drive(self, command: np.ndarray) -> None:
        """Makes one physics step with desired motor angles `[8]`, rad."""
        angle, rate = self._joints(self.motors) * DIRECTION
        given, self.torque = motor_torques(command, angle, rate)
        hotter = np.where(np.abs(given) > HOT, self.heat + 1, 0)
        self.heat = np.where(self.heat > PATIENT, self.heat, hotter)
        self.push(np.where(self.heat > PATIENT, 0.0, given * DIRECTION))
        self.bullet.stepSimulation()

    def push(self, torques: np.ndarray) -> None:
        self.bullet.setJointMotorControlArray(
            self.body, self.motors, self.bullet.TORQUE_CONTROL, forces=torques.tolist()
        )

    def close(self) -> None:
        """Disconnects from Bullet and frees its memory; garbage collection does the same."""
        self._end()


# ── a worker ────────────────────────────────────────────────────────────────────────────────


def serve(solver: Solver, patience: float) -> None:
    """Answers requests from stdin on stdout until stdin closes or the parent process ends.

    First it sends the settled initial state, a row `[61]`. A request is an int32 n and n rows
    `[69]` of state and action; its answer is n rows `[61]`, the states after a control step. All
    rows are float32.

    Args:
      solver: settings of Bullet.
      patience: seconds for a request; a timer kills a worker that takes longer.
    """
    source, sink = os.dup(0), os.dup(1)
    os.dup2(2, 1)  # keeps messages of Bullet out of the answers
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    simulation, parent = Simulation(solver), os.getppid()
    send(sink, simulation.read())
    while (count := receive(source, 1, np.int32, parent)) is not None:
        signal.setitimer(signal.ITIMER_REAL, patience)
        rows = receive(source, int(count[0]) * (WIDTH + ACTIONS), np.float32, parent)
        if rows is None:
            return
        send(sink, np.stack([stepped(simulation, row) for row in rows.reshape(count[0], -1)]))
        signal.setitimer(signal.ITIMER_REAL, 0)


def stepped(simulation: Simulation, row: np.ndarray) -> np.ndarray:
    """State `[61]` one control step after the state and action in `row [69]`."""
    simulation.set_state(row[:WIDTH])
    simulation.step(row[WIDTH:].astype(np.float64))
    after = simulation.read()
    if not (np.abs(after) < ABSURD).all():
        # Else invalid numbers would stay in Bullet's contacts and spoil later steps.
        simulation.reset()
    return after


def send(sink: int, rows: np.ndarray) -> None:
    """Writes rows as float32."""
    data = memoryview(rows.astype(np.float32).tobytes())
    while data:
        data = data[os.write(sink, data) :]


def receive(source: int, count: int, kind: Any, parent: int) -> np.ndarray | None:
    """Reads `count` numbers; None if the pipe is closed or the parent process has ended."""
    size, data = count * np.dtype(kind).itemsize, b""
    ready = select.poll()
    ready.register(source, select.POLLIN)
    while len(data) < size:
        if not ready.poll(1000):
            # After the parent's death, a process that it forked may keep the pipe open.
            if os.getppid() != parent:
                return None
            continue
        part = os.read(source, size - len(data))
        if not part:
            return None
        data += part
    return np.frombuffer(data, kind)


if __name__ == "__main__":
    given, seconds = sys.argv[1:]
    serve(Solver(**json.loads(given)), float(seconds))
