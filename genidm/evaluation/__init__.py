"""The paper's test (A.1.3), waypoints (§5.3), and the statistics of their episodes."""
