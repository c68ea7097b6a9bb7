"""The settings of the author's code (docs/authors.md), beside the paper's (`paper_settings`).

The code is `aditimavalankar/gc-batch-rl-locomotion` on GitHub, of the published paper (arXiv
2004.08356). It has no licence: the facts are from it, the code is not. Its test is
`genidm.evaluation.scenarios.box_scenarios`, its Ant `genidm.robots.AntV2`.
"""

from __future__ import annotations

import dataclasses
import math

from genidm.checks import check_value, count
from genidm.paper.fit import Fit
from genidm.paper.methods import InverseDynamics, paper_settings
from genidm.robots import Ant, Robot

EPOCHS = 1000
# A fifth of the pairs is only validated on.
LEARNED = 4 / 5


def author_settings(
    method: InverseDynamics, robot: Robot, epochs: int = EPOCHS, fraction: float | None = None
) -> InverseDynamics:
    """Give a method the settings of the author's code.

    They are the paper's (`paper_settings`: h = 1, whole-episode replay, λ = 0.25, mean latents,
    constant learning rate), with networks that end in ReLU and tanh, with mean squared errors as
    losses, and with as many minibatches as the epochs have.

    Args:
      method: a method of Table 1, on the Ant.
      robot: its Ant, for A and the number of interactions.
      epochs: passes over the pairs; the default is the author's.
      fraction: fraction of the record, from its start, that makes the pairs; the default is the
        paper's.

    Raises:
      BadInput: there is no epoch.
    """
    check_value("epochs", epochs, count())
    papers = paper_settings(method, Ant.name)
    if fraction is not None:
        papers = dataclasses.replace(papers, fraction=fraction)
    pairs = LEARNED * papers.fraction * robot.paper_interactions
    updates = epochs * math.ceil(pairs / papers.fit.batch_size)
    fit = dataclasses.replace(papers.fit, network="author", updates=updates)
    return dataclasses.replace(
        papers, name=f"{method.name} author", fit=with_mean_losses(fit, robot.action.size)
    )


def with_mean_losses(fit: Fit, action_size: int) -> Fit:
    """Weight the losses as if they were means over the numbers of γ and of a, not sums.

    The mean squared errors are L1 / k and L2 / A. Adam's steps do not depend on the scale of a
    loss, so only the ratio matters: λ / k to (1 − λ) / A. The weight with this ratio replaces λ.

    Args:
      fit: settings with the weight λ of means.
      action_size: A, length of an action.
    """
    if fit.latent_size is None:
        return fit
    latent = fit.latent_loss_weight / fit.latent_size
    action = (1 - fit.latent_loss_weight) / action_size
    return dataclasses.replace(fit, latent_loss_weight=latent / (latent + action))
