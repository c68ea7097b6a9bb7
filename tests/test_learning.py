"""An agent learns to walk on a real robot, and random weights do not."""

from __future__ import annotations

from genidm.agents.ppo import PPO

# Few robots, which make much of each step: it need not learn well, but soon.
AGENT = PPO(lanes=64, unroll=16, discount=0.97, learning_rate=1e-3, entropy=0.0)
