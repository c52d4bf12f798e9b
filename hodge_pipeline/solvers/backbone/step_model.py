"""How the steps of a chain usually are, and how rare each step is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.chi2 import tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS
from hodge_pipeline.types import Floats

TAIL = 0.1
"""Share of the most unusual steps, to which the tail of the sizes is fitted (Hill 1975)."""
LEAST = 1e-6
"""Share of each variance that is added to it."""


@dataclass(frozen=True)
class StepModel:
    """The distribution of the motions of a chain's steps.

    - `centre (4, 4)`: of the usual step; `covariance (p, p)`.
    - `unusual (n,)`: by how many nats each step is rarer than the rarest of as many should be.
    """

    centre: Floats
    covariance: Floats
    unusual: Floats

    @classmethod
    def of(cls, chain: Chain) -> StepModel:
        """Fitted to the steps with Student's t, which single steps hardly change, and to the tail of their χ².

        Each step counts with its mirror image, since turns to the right are as usual as those to the left.
        """
        rows = np.flatnonzero((chain.step_edge >= 0) & ~chain.bridged)
        twist = chain.log(chain.step[rows])
        twist = np.concatenate([twist, twist @ _mirrored(chain, twist)])
        centre = np.median(twist, axis=0)
        covariance, chi2 = _student_covariance(twist - centre)
        unusual = np.full(chain.size, -np.inf)
        unusual[rows] = _rarity(chi2[: len(rows)]) - np.log(len(rows))
        return cls(chain.exp(centre), covariance, unusual)

    def off(self, chain: Chain, motion: Floats) -> Floats:
        """Twists (M, p) from the centre to motions (M, 4, 4)."""
        return chain.log(chain.between(self.centre, motion))


def _student_covariance(left: Floats) -> tuple[Floats, Floats]:
    """The covariance (p, p) of residuals (M, p), with weights by Student's t, and their χ² (M,)."""
    weight = np.ones(len(left))
    for _ in range(MOST_ROUNDS):
        covariance = (left * weight[:, None]).T @ left / len(left)
        covariance += np.diag(LEAST * np.diag(covariance) + np.finfo(float).tiny ** 0.5)
        chi2 = mahalanobis(left, np.broadcast_to(covariance, (len(left), *covariance.shape)))[0]
        weight = tail_weight(chi2, left.shape[1])
    return covariance, chi2


def _rarity(chi2: Floats) -> Floats:
    """Minus the log-probability (M,) of a larger χ², by an exponential tail of the logarithms of these (Hill 1975)."""
    size = np.log(np.maximum(chi2, np.finfo(float).tiny)) / 2
    floor = np.quantile(size, 1 - TAIL)
    mean = float(np.mean(size[size > floor] - floor)) if (size > floor).any() else np.inf
    return np.asarray(np.maximum((size - floor) / mean + np.log(1 / TAIL), 0.0))


def _mirrored(chain: Chain, twist: Floats) -> Floats:
    """The rotation (p, p) of twists (M, p) by 180° about their median direction of travel."""
    ahead = np.zeros(6)
    ahead[chain.axes] = np.median(twist, axis=0)
    half = 2 * np.outer(ahead[3:], ahead[3:]) / max(float(ahead[3:] @ ahead[3:]), np.finfo(float).tiny) - np.eye(3)
    return np.asarray(np.kron(np.eye(2), half)[np.ix_(chain.axes, chain.axes)], float)
