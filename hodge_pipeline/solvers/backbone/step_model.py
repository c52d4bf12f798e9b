"""How the steps of a chain usually are: kinds of motions, and how rare each step is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline.complex.chi2 import tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.linear import cholesky
from hodge_pipeline.types import Bools, Floats

TAIL = 0.1
"""Share of the most unusual steps, to which the tail of the sizes is fitted (Hill 1975)."""
ROUNDS, LEAST = 10, 1e-6
"""Reweighting rounds of `StepModel`, and the share of each variance that is added to it."""
OF_ONE_KIND, FEWEST_OF_KIND = 3.0, 3
"""Largest χ² per axis of a step of a kind, and fewest steps of a kind."""
MOST_KINDS, MOST_COMPARED = 8, 2000
"""Kinds, and steps compared with all others to find one: limits on cost."""


@dataclass(frozen=True)
class StepModel:
    """A mixture of the motions of a chain's steps.

    - `centres (K, 4, 4)`: of the kinds of steps, such as straight on and round a corner, the most frequent first;
      `shares (K,)` of the steps; one `covariance (p, p)`; `kind (n,)`: which steps are of any of them.
    - `unusual (n,)`: by how many nats each step is rarer, beside its nearest kind, than the rarest of as many should
      be.
    """

    centres: Floats
    shares: Floats
    covariance: Floats
    kind: Bools
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
        left = twist - centre
        covariance = _student_covariance(left)
        whiten = np.linalg.inv(cholesky(covariance[None])[0]).T
        centres, shares, of_one = _kinds(left, left @ whiten)
        chi2 = cKDTree(centres @ whiten).query(left @ whiten)[0] ** 2
        unusual = np.full(chain.size, -np.inf)
        unusual[rows] = _rarity(chi2[: len(rows)]) - np.log(len(rows))
        kind = np.zeros(chain.size, bool)
        kind[rows] = of_one[: len(rows)]
        return cls(chain.exp(centre + centres), shares, covariance, kind, unusual)

    def off(self, chain: Chain, motion: Floats) -> Floats:
        """Twists (K, M, p) from each kind's centre to motions (M, 4, 4)."""
        return chain.log(chain.between(self.centres[:, None], motion))


def _student_covariance(left: Floats) -> Floats:
    """The covariance (p, p) of residuals (M, p), with weights by Student's t."""
    weight = np.ones(len(left))
    for _ in range(ROUNDS):
        covariance = (left * weight[:, None]).T @ left / len(left)
        covariance += np.diag(LEAST * np.diag(covariance) + np.finfo(float).tiny ** 0.5)
        chi2 = mahalanobis(left, np.broadcast_to(covariance, (len(left), *covariance.shape)))[0]
        weight = tail_weight(chi2, left.shape[1])
    return covariance


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


def _kinds(left: Floats, white: Floats) -> tuple[Floats, Floats, Bools]:
    """The centres (K, p) of kinds of steps, the share (K,) of each, and which steps (M,) are of one; `left (M, p)`:
    twists about their median, `white (M, p)`: the same whitened.
    """
    size, gate = left.shape[1], OF_ONE_KIND * left.shape[1]
    other = (white**2).sum(axis=1) > gate
    centres, counts = [np.zeros(size)], [max(float((~other).sum()), 1.0)]
    while other.sum() >= FEWEST_OF_KIND and len(centres) < MOST_KINDS:
        rows = np.flatnonzero(other)
        some = white[rows[:: -(-len(rows) // MOST_COMPARED)]]
        near = cKDTree(some).query_ball_point(some, np.sqrt(gate), return_length=True)
        alike = rows[((white[rows] - some[np.argmax(near)]) ** 2).sum(axis=1) <= gate]
        if len(alike) < FEWEST_OF_KIND:
            break
        centres.append(np.median(left[alike], axis=0))
        counts.append(float(len(alike)))
        other[alike] = False
    return np.stack(centres), np.array(counts) / len(left), ~other
