"""One Minitaur in PyBullet: the model of `pybullet_envs`, without gym.

Run as a script this file is a worker, which steps whatever robots it is sent (`serve`). So it
imports nothing of genidm: a worker starts in half a second, and holds neither jax nor a model.

Bullet's world is the frame: z up, metres, radians. Joints are counted as the motors are: by
leg, front left, back left, front right, back right, in each leg L before R, with the sign
that makes both sides alike.
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

# ── constants, all of pybullet_envs (bullet/minitaur.py, motor.py, minitaur_gym_env.py) ─────

URDF = "quadruped/minitaur.urdf"  # in pybullet_data
LEGS = ("front_left", "back_left", "front_right", "back_right")
MOTORS = [f"motor_{leg}{side}_joint" for leg in LEGS for side in "LR"]
KNEES = [f"knee_{leg}{side}_link" for leg in LEGS for side in "LR"]
DIRECTION = np.repeat([-1.0, 1.0], 4)

SUBSTEP = 0.002  # s; the motors are commanded at each
SUBSTEPS = 5  # a control step
GRAVITY = -10.0  # m/s²
START_HEIGHT = 0.2  # m
SETTLING = 100  # physics steps with every motor told to stay at a quarter turn
MOTOR_START, KNEE_START = math.pi / 2, -2.1834  # rad
# Where the two shins of a leg are joined, in the frame of each, metres.
JOINED_RIGHT, JOINED_LEFT = (0.0, 0.005, 0.2), (0.0, 0.01, 0.2)

KP, KD = 1.0, 0.02  # of full voltage a rad, a rad/s
VOLTAGE, VOLTAGE_CLIP = 16.0, 50.0  # V
RESISTANCE = 0.186  # Ω
TORQUE_CONSTANT = 0.0954  # N·m/A, and V·s/rad
OBSERVED_LIMIT = 5.7  # N·m, of the torque that the sensor gives
CURRENTS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)  # A, and the torque at each:
TORQUES = (0.0, 1.0, 1.9, 2.45, 3.0, 3.25, 3.5)  # N·m
# A motor that gives more than so many N·m for over a second (in physics steps) is off for good.
HOT, PATIENT = 2.45, 1.0 / SUBSTEP

SWING = np.array([1, -1, 1, -1, -1, 1, -1, 1])  # which way a motor turns to swing its leg
EXTENSION_OFFSET = 1.5  # of the leg model: legs stand half bent at action 0
FALLEN_UP, FALLEN_HEIGHT = 0.85, 0.13  # cosine of the tilt; m
ENERGY_WEIGHT = 0.005  # of a joule, against a metre

# Metres, rad/s, and so on: beyond, or where there is no number at all, the physics is lost.
ABSURD = 1e4
# Where nothing touches, metres: what lies still there has no contacts.
ALOFT = 50.0

ROW = {
    "position": 3, "orientation": 4, "angles": 16, "velocity": 3, "spin": 3, "rates": 16,
    "heat": 8, "torque": 8,
}  # fmt: skip
"""All that a step depends on, and how many numbers each takes in a row `[61]`.

Base position (m), orientation (w, x, y, z), joint angles (rad, motors before knees); base
velocity (m/s) and spin (rad/s) in the world frame, joint velocities (rad/s); for how many
physics steps each motor has been hot; the torque that its sensor gave last (N·m).
"""
WIDTH = sum(ROW.values())
ACTIONS = 8

# Joint angles at the start, motors before knees.
REST = np.repeat([MOTOR_START, KNEE_START], 8)


@dataclasses.dataclass(frozen=True)
class Solver:
    """Settings of Bullet, chosen by measuring (docs/physics.md).

    Attributes:
      iterations: of the constraint solver; 60 is that of pybullet_envs.
      self_collision: legs collide with each other and the body, as in pybullet_envs.
      cone: true friction cones, as in pybullet_envs. Off, a turned replay stays near the
        record for longer.
    """

    iterations: int = 60
    self_collision: bool = False
    cone: bool = False


def parts(row: np.ndarray) -> dict[str, np.ndarray]:
    """The numbers of a row `[61]` by name, as ROW has them."""
    return dict(zip(ROW, np.split(row, np.cumsum([*ROW.values()])[:-1]), strict=True))


def motor_angles(action: np.ndarray) -> np.ndarray:
    """The leg model: motor angles `[8]` in radians that an action `[8]` in [−1, 1] asks for.

    Of each leg, the action has first how far it swings, ±45° at 1, and in its second half how
    far it stretches, 45° of both motors at 1.
    """
    swing, extension = np.repeat(np.clip(action, -1.0, 1.0).reshape(2, 4), 2, axis=1)
    return math.pi + math.pi / 4 * (SWING * swing - extension - EXTENSION_OFFSET)


def motor_torques(
    command: np.ndarray, angle: np.ndarray, rate: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The DC motors under position control: torque given and torque observed, `[8]`, N·m.

    Args:
      command: `[8]`, rad.
      angle: `[8]`, rad.
      rate: `[8]`, rad/s.
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
    """What a control step is charged for energy `[...]`, in the reward's metres.

    0.005 |τ·q̇| Δt, where Δt is one physics step of the five, the last, as in pybullet_envs.

    Args:
      torque: `[..., 8]`, as observed, N·m.
      rate: `[..., 8]`, rad/s.
    """
    return ENERGY_WEIGHT * abs((torque * rate).sum(-1)) * SUBSTEP


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Lets nothing through to stdout and stderr: PyBullet greets on both, from C."""
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
    """PyBullet's functions, of one physics server of the many that a process may have."""

    def __init__(self, pybullet: Any, server: int):
        self._pybullet, self._server = pybullet, server

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._pybullet, name)
        if inspect.isbuiltin(found):
            found = functools.partial(found, physicsClientId=self._server)
        setattr(self, name, found)
        return found


class Simulation:
    """A Minitaur on a plane; it goes on from where it is, as simulations do.

    It starts anew by `reset`, which loads everything afresh, or by `set_state`, in any state.

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
        """The start of pybullet_envs, facing `yaw` (rad): all is loaded, dropped, and settled."""
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
            # The order of contacts is that of the robot's links, not of what came before.
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
        # Bullet's own motors, which brake every joint unless they are told not to.
        bullet.setJointMotorControlArray(
            body, self.motors + self.knees, bullet.VELOCITY_CONTROL,
            targetVelocities=[0] * 16, forces=[0] * 16,
        )  # fmt: skip

    def _set_joints(self, angles: np.ndarray, rates: np.ndarray) -> None:
        """Angles and rates `[16]`, motors before knees."""
        q, v = (x * np.tile(DIRECTION, 2) for x in (angles, rates))
        self.bullet.resetJointStatesMultiDof(
            self.body, self.motors + self.knees, q[:, None].tolist(), v[:, None].tolist()
        )

    def set_state(self, row: np.ndarray) -> None:
        """Puts the robot into the state that `row [61]` says.

        What follows depends on the row alone, to the last bit: Bullet keeps contacts from one
        step to the next, so those of before are got rid of first, high up in the air.
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
        """Angles and rates `[2, joints]`, as Bullet counts them."""
        states = self.bullet.getJointStates(self.body, joints)
        return np.array([state[:2] for state in states]).T

    def step(self, action: np.ndarray) -> None:
        """One control step under an action `[8]`."""
        command = motor_angles(action)
        for _ in range(SUBSTEPS):
            self._drive(command)

    def _drive(self, command: np.ndarray) -> None:
        """One physics step, the motors told to go to angles `[8]`."""
        angle, rate = self._joints(self.motors) * DIRECTION
        given, self.torque = motor_torques(command, angle, rate)
        hotter = np.where(np.abs(given) > HOT, self.heat + 1, 0)
        self.heat = np.where(self.heat > PATIENT, self.heat, hotter)
        self._push(np.where(self.heat > PATIENT, 0.0, given * DIRECTION))
        self.bullet.stepSimulation()

    def _push(self, torques: np.ndarray) -> None:
        self.bullet.setJointMotorControlArray(
            self.body, self.motors, self.bullet.TORQUE_CONTROL, forces=torques.tolist()
        )

    def close(self) -> None:
        """Ends the simulation and frees what it holds; so does letting go of it."""
        self._end()


# ── a worker ────────────────────────────────────────────────────────────────────────────────


def serve(solver: Solver, patience: float) -> None:
    """Steps robots that come on stdin until nobody is left to send any.

    First the settled start goes out, a row `[61]`. Then each request is an int32 n and n rows
    of state and action `[69]`, and its answer n rows of the state after a control step; all
    float32.

    Args:
      solver: settings of Bullet.
      patience: seconds for a request; the kernel ends a worker that takes longer.
    """
    source, sink = os.dup(0), os.dup(1)
    os.dup2(2, 1)  # what Bullet may have to say
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who sends
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
        # Bullet does not get over it by itself: it would go on among its contacts.
        simulation.reset()
    return after


def send(sink: int, rows: np.ndarray) -> None:
    """Writes rows as float32."""
    data = memoryview(rows.astype(np.float32).tobytes())
    while data:
        data = data[os.write(sink, data) :]


def receive(source: int, count: int, kind: Any, parent: int) -> np.ndarray | None:
    """Reads `count` numbers; None once the other end is closed, or the parent is gone."""
    size, data = count * np.dtype(kind).itemsize, b""
    ready = select.poll()
    ready.register(source, select.POLLIN)
    while len(data) < size:
        if not ready.poll(1000):
            # A process that the parent forked may hold the pipe open after its death.
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
