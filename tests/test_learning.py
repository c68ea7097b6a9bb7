"""An agent learns to walk on a real robot, and random weights do not."""

from __future__ import annotations

import jax
import pytest

from genidm.agents.ppo import PPO
from genidm.agents.collect import collect
from genidm.evaluation.evaluate import walking_speed
from genidm.robots import Ant
from genidm.tasks import WalkForward

# Few robots, which make much of each step: it need not learn well, but soon.
AGENT = PPO(lanes=64, unroll=16, discount=0.97, learning_rate=1e-3, entropy=0.0)
