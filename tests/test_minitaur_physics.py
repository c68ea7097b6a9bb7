"""What is measured of the Minitaur in PyBullet: that the measures see what they are named for."""

from __future__ import annotations

import dataclasses
import os
import time

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="PyBullet is not installed: there is no wheel of it here")

from experiments import minitaur_physics, minitaur_processes
from experiments.minitaur_physics import OURS, OneByOne, gait, hard, live, placed, walk
from genidm.robots.minitaur_world import Simulation


def test_batched_calls_walk_as_one_call_a_joint_does() -> None:
    batched, each = Simulation(OURS), OneByOne(OURS)
    for action in gait()[:50]:
        np.testing.assert_array_equal(live(batched, action), live(each, action))


def test_a_walk_is_measured_until_the_robot_falls() -> None:
    ahead, height, pitch, steps, ms = walk(OURS, True, 0)
    assert steps == len(gait()) and 0.5 < ahead < 2 and 0.1 < height < 0.3
    assert abs(pitch) < 0.2 and ms > 0


def test_a_hard_reset_turns_the_way_by_its_yaw() -> None:
    yaw, actions = 2.0, gait()[:20]
    straight, turned = hard(OURS, 0.0, actions), hard(OURS, yaw, actions)
    cos, sin = np.cos(yaw), np.sin(yaw)
    exact = straight[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    np.testing.assert_allclose(turned[:, :2], exact, atol=3e-3)
    assert np.linalg.norm(turned - straight, axis=-1).max() > 1e-2


def test_a_placed_replay_is_another_way_than_a_live_one() -> None:
    """Placing rounds to float32 and clears the contacts that Bullet keeps."""
    start = minitaur_physics.settled(OURS)
    there, alive = placed(OURS, start, gait()[:20]), hard(OURS, 0.0, gait()[:20])
    apart = np.linalg.norm(there - alive, axis=-1)
    assert 0 < apart[-1] < 1e-3


def test_a_busy_process_has_run_as_long_as_its_own_clock_says() -> None:
    before, began = minitaur_processes.busy([os.getpid()]), time.process_time()
    while time.process_time() < began + 0.3:
        pass
    ran, waited = (minitaur_processes.busy([os.getpid()]) - before)[:, 0]
    assert waited >= 0 and ran == pytest.approx(0.3, abs=0.1)


def test_what_is_lost_beside_the_slowest_process_is_wall_time_over_its_own() -> None:
    def step() -> None:
        began = time.process_time()
        while time.process_time() < began + 0.05:
            pass
        time.sleep(0.05)

    measured = minitaur_processes.Vectorised("idle half the time", 10, [os.getpid()], step)
    row = measured.measured(4)
    assert row["steps_per_second"] == pytest.approx(100, rel=0.3)
    assert row["over_slowest"] == pytest.approx(1, rel=0.4)
    assert row["ms_cpu"] == pytest.approx(5, rel=0.4)


def test_speed_is_told_beside_one_process_of_the_same_kind() -> None:
    row = {"what": "ours", "processes": 1, "lanes": 8, "steps_per_second": 500.0}
    row |= {"ms_cpu": 2.0, "over_slowest": 0.02}
    fast = {**row, "processes": 4, "steps_per_second": 1750.0}
    said = minitaur_processes.processes_table([row, fast])
    assert "3.50" in said.splitlines()[-1] and "1.00" in said.splitlines()[-2]


def test_options_that_measure_nothing_are_refused() -> None:
    with pytest.raises(minitaur_physics.BadInput, match="num-envs"):
        dataclasses.replace(minitaur_physics.Options(), num_envs=0).check()
