"""Settings that cannot be are refused where they are declared."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from genidm.agents.ddpg import DDPG
from genidm.agents.frozen import Frozen
from genidm.agents.her import HER
from genidm.agents.ppo import PPO
from genidm.agents.random import RandomActions
from genidm.agents.sac import SAC
from genidm.checks import count, layers, number, optional, positive
from genidm.errors import BadInput
from genidm.evaluation.evaluate import EvaluationSettings
from genidm.evaluation.planners import ArcPlanner
from genidm.evaluation.waypoints import WaypointSettings
from genidm.paper.fit import Fit
from genidm.paper.generalize import Generalize
from genidm.paper.methods import LR, VGCP
from genidm.tasks import Dense, GoToGoal, WalkForward
from genidm.video import RenderSettings

SETTINGS = [
    PPO(),
    SAC(),
    DDPG(),
    HER(),
    RandomActions(),
    Frozen(PPO(), 0.5),
    Fit(),
    EvaluationSettings(),
    Generalize(),
    WaypointSettings(),
    ArcPlanner(),
    WalkForward(),
    GoToGoal(),
    Dense(),
    RenderSettings(),
    LR,
    VGCP,
]


def numbers(settings: Any) -> list[str]:
    return [
        f.name
        for f in dataclasses.fields(settings)
        if isinstance(getattr(settings, f.name), int | float)
        and not isinstance(getattr(settings, f.name), bool)
    ]


CASES = [(settings, name) for settings in SETTINGS for name in numbers(settings)]


@pytest.mark.parametrize(
    ("settings", "name"), CASES, ids=[f"{type(s).__name__}.{n}" for s, n in CASES]
)
def test_every_number_has_a_range(settings: Any, name: str) -> None:
    for wrong in (math.nan, math.inf, -math.inf, -1, "1", None if name != "segment" else -1):
        with pytest.raises(BadInput, match=rf"{name}\)? (must|never|holds)|{name}"):
            dataclasses.replace(settings, **{name: wrong})
    if isinstance(getattr(settings, name), int):
        for wrong in (10**30, 1.5):
            with pytest.raises(BadInput, match=name):
                dataclasses.replace(settings, **{name: wrong})


@pytest.mark.parametrize(
    ("settings", "name", "wrong"),
    [
        (PPO(), "discounting", 1.5),
        (PPO(), "discounting", 1.0),
        (PPO(), "gae_lambda", 7),
        (PPO(), "clipping_epsilon", 0),
        (PPO(), "max_grad_norm", 0),
        (SAC(), "tau", 1.1),
        (Fit(), "latent_loss_weight", 1.0),
        (LR, "fraction", 1.2),
        (RenderSettings(), "fps", 0),
        (WaypointSettings(), "goal_radius", 0),
    ],
)
def test_ends_of_ranges(settings: Any, name: str, wrong: float) -> None:
    with pytest.raises(BadInput, match=name):
        dataclasses.replace(settings, **{name: wrong})


@pytest.mark.parametrize("wrong", [(0,), (-1,), (64, 0), (64, 10**9), (1.5,), 64, ("64",)])
@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (PPO(), "policy_hidden_layer_sizes"),
        (PPO(), "value_hidden_layer_sizes"),
        (SAC(), "critic_hidden_layer_sizes"),
        (Fit(), "idm"),
        (Fit(), "lfm"),
    ],
)
def test_widths_of_layers(settings: Any, name: str, wrong: Any) -> None:
    with pytest.raises(BadInput, match=name):
        dataclasses.replace(settings, **{name: wrong})


@pytest.mark.parametrize("name", ["a\nb", "\x1b[31mred", "a/b", ".hidden", "  "])
def test_names_of_methods_can_be_printed_and_name_directories(name: str) -> None:
    with pytest.raises(BadInput, match="a method's name"):
        dataclasses.replace(LR, name=name)


def test_numpy_numbers_are_numbers() -> None:
    assert count()(np.int32(3)) is None and number()(np.float32(0.5)) is None
    assert count()(True) and number()(True) and positive()(np.nan)
    assert optional(count())(None) is None and layers((64, np.int64(32))) is None
