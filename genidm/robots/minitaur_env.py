"""The Minitaur as a `gymnasium.Env`, for learners of other packages.

env = gymnasium.vector.AsyncVectorEnv([MinitaurEnv] * 8)   # one process per environment
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from genidm.errors import BadInput
from genidm.robots.minitaur import OBSERVATIONS, Observed
from genidm.robots.minitaur_world import ACTIONS, Simulation, Solver, charge, has_fallen, parts


class MinitaurEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One Minitaur with the task of pybullet_envs: walk towards +x.

    The reward of a step is Δx − 0.005 |τ·q̇| Δt, where Δt is one physics step. The episode ends
    with a fall and has no time limit (use `gymnasium.wrappers.TimeLimit`). Observations and
    actions are those of `genidm.robots.Minitaur`. Its motion differs in one point: the state is
    not set before every step, so Bullet keeps contacts from one step to the next.

    Args:
      solver: settings of Bullet.
      observed: content of s, "paper17" or "native28".
    """

    def __init__(self, solver: Solver | None = None, observed: Observed = "paper17"):
        self.simulation = Simulation(solver)
        self._observed = observed
        size = OBSERVATIONS[observed].size
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = Box(-1.0, 1.0, (ACTIONS,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Loads the simulation anew and returns the first observation.

        Args:
          seed: no effect, because all initial states are equal.
          options: "yaw", the initial yaw in radians (default 0); or "row" `[61]`, the initial
            state (`genidm.robots.minitaur_world.ROW`).
        """
        super().reset(seed=seed)
        options = options or {}
        self.simulation.reset(options.get("yaw", 0.0))
        if "row" in options:
            self.simulation.set_state(options["row"])
        return self._observe(parts(self.simulation.read())), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        given, last = action, self.simulation.read()
        try:
            action = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            action = np.full(0, np.nan)
        if action.shape != (ACTIONS,) or not np.isfinite(action).all():
            raise BadInput(f"an action must be {ACTIONS} finite numbers, not {given!r:.80}")
        before = last[0]
        self.simulation.step(action)
        row = self.simulation.read()
        if not np.isfinite(row).all():  # such a row has no observation
            return self._observe(parts(last)), 0.0, True, False, {"row": row}
        x = parts(row)
        reward = x["position"][0] - before - charge(x["torque"], x["rates"][:8])
        fallen = bool(has_fallen(x["orientation"], x["position"][2]))
        return self._observe(x), float(reward), fallen, False, {"row": row}

    def _observe(self, x: dict[str, np.ndarray]) -> np.ndarray:
        angles, rates = x["angles"][:8], x["rates"][:8]
        orientation = x["orientation"]
        if self._observed == "native28":
            upright = orientation * (-1 if orientation[0] < 0 else 1)
            s = [angles, rates, x["torque"], upright]
        else:
            euler = self.simulation.bullet.getEulerFromQuaternion(np.roll(orientation, -1))
            s = [angles, x["velocity"], x["spin"], euler]
        return np.concatenate(s).astype(np.float32)

    def close(self) -> None:
        self.simulation.close()
