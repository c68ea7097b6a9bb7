"""genidm: goal-directed locomotion learned from experience that was never goal-directed.

The names in `__all__` are the public API (docs/api.md). Each is imported when it is first used, so
`import genidm` itself does no work and does not import jax.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from genidm import engines as engines
    from genidm import paper as paper
    from genidm import report as report
    from genidm import robots as robots
    from genidm import symmetry as symmetry
    from genidm import video as video
    from genidm.agents.collect import collect as collect
    from genidm.agents.ddpg import DDPG as DDPG
    from genidm.agents.frozen import Frozen as Frozen
    from genidm.agents.her import HER as HER
    from genidm.agents.ppo import PPO as PPO
    from genidm.agents.random import RandomActions as RandomActions
    from genidm.agents.sac import SAC as SAC
    from genidm.controller import Controller as Controller
    from genidm.controller import load as load
    from genidm.controller import pretrained as pretrained
    from genidm.errors import BadInput as BadInput
    from genidm.evaluation.episodes import Episodes as Episodes
    from genidm.evaluation.evaluate import EvaluationSettings as EvaluationSettings
    from genidm.evaluation.evaluate import evaluate as evaluate
    from genidm.evaluation.scenarios import Scenarios as Scenarios
    from genidm.evaluation.scenarios import scenarios as scenarios
    from genidm.evaluation.waypoints import WaypointSettings as WaypointSettings
    from genidm.evaluation.waypoints import follow_waypoints as follow_waypoints
    from genidm.experience import Experience as Experience
    from genidm.paper.fit import Fit as Fit
    from genidm.paper.fit import fit as fit
    from genidm.paper.generalize import Generalize as Generalize
    from genidm.paper.generalize import generalize as generalize
    from genidm.paper.held_out import held_out_error as held_out_error
    from genidm.paper.methods import GE as GE
    from genidm.paper.methods import HER_DE as HER_DE
    from genidm.paper.methods import HER_SP as HER_SP
    from genidm.paper.methods import HF as HF
    from genidm.paper.methods import LR as LR
    from genidm.paper.methods import RL as RL
    from genidm.paper.methods import RS as RS
    from genidm.paper.methods import VGCP as VGCP
    from genidm.robots import Ant as Ant
    from genidm.robots import Humanoid as Humanoid
    from genidm.robots import HumanoidWorld as HumanoidWorld
    from genidm.robots import Logged as Logged
    from genidm.robots import Minitaur as Minitaur
    from genidm.robots import Robot as Robot
    from genidm.symmetry import Layout as Layout
    from genidm.tasks import Dense as Dense
    from genidm.tasks import GoToGoal as GoToGoal
    from genidm.tasks import Sparse as Sparse
    from genidm.tasks import WalkForward as WalkForward

# Module → the public names that come from it, in the order of docs/api.md; a module without
# names is public itself. A test compares this with the imports above.
_HOMES: dict[str, tuple[str, ...]] = {
    "robots": ("Ant", "Humanoid", "HumanoidWorld", "Minitaur", "Logged", "Robot"),
    "agents.ppo": ("PPO",),
    "agents.sac": ("SAC",),
    "agents.ddpg": ("DDPG",),
    "agents.her": ("HER",),
    "agents.frozen": ("Frozen",),
    "agents.random": ("RandomActions",),
    "tasks": ("WalkForward", "GoToGoal", "Sparse", "Dense"),
    "agents.collect": ("collect",),
    "experience": ("Experience",),
    "paper.generalize": ("generalize", "Generalize"),
    "paper.fit": ("fit", "Fit"),
    "paper.held_out": ("held_out_error",),
    "controller": ("Controller", "load", "pretrained"),
    "evaluation.scenarios": ("scenarios", "Scenarios"),
    "evaluation.evaluate": ("evaluate", "EvaluationSettings"),
    "evaluation.episodes": ("Episodes",),
    "evaluation.waypoints": ("follow_waypoints", "WaypointSettings"),
    "paper.methods": ("RS", "RL", "VGCP", "HER_SP", "HER_DE", "GE", "LR", "HF"),
    "symmetry": ("Layout",),
    "errors": ("BadInput",),
}
_MODULES = ("engines", "paper", "report", "robots", "symmetry", "video")
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [*_HOME, *_MODULES]

if not TYPE_CHECKING:  # a type checker would take every name for one of these

    def __getattr__(name: str) -> Any:
        if name in _MODULES:
            return import_module(f"genidm.{name}")
        if name not in _HOME:
            raise AttributeError(f"module 'genidm' has no attribute {name!r}")
        found = getattr(import_module(f"genidm.{_HOME[name]}"), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
