"""What speaks for a loop: the density of its residual if it is right, against that if it joins places at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.fit import root
from hodge_pipeline.types import Floats

PAIRS = 4000
"""Random pairs of positions that say how far apart places lie."""
LEAST_SPREAD = 1e-3
"""Of the largest: the spread of places along an axis in which they hardly differ."""


@dataclass(frozen=True)
class Wrong:
    """The residual of a loop between two places at random: a Cauchy distribution of `shape (p, p)` in axes that are
    parallel to the world's and begin at the loop's later end.
    """

    precision: Floats
    log_scale: float

    @classmethod
    def of(cls, chain: Chain, poses: Floats) -> Wrong:
        """As the motions of the loops are between random positions of one path."""
        rng = np.random.default_rng(0)
        pairs = rng.integers(0, chain.size, (PAIRS, 2))
        pairs = pairs[chain.path[pairs[:, 0]] == chain.path[pairs[:, 1]]]
        motion = chain.motion[rng.integers(0, len(chain.motion), len(pairs))]
        residual = parallel(chain, motion, poses[pairs[:, 0]], poses[pairs[:, 1]])
        moment = residual.T @ residual / max(len(residual), 1)
        split = turns(chain)
        shape = np.zeros_like(moment)
        shape[:split, :split], shape[split:, split:] = (
            _floored(moment[:split, :split]),
            _floored(moment[split:, split:]),
        )
        size = len(shape)
        norm = gammaln((1 + size) / 2) - gammaln(0.5) - 0.5 * size * np.log(np.pi)
        return cls(np.asarray(np.linalg.inv(shape), float), 0.5 * float(np.linalg.slogdet(shape)[1]) - float(norm))

    def log_density(self, chain: Chain, poses: Floats) -> Floats:
        """Of all loops (M,)."""
        a, b = chain.ends.T
        residual = parallel(chain, chain.motion, poses[a], poses[b])
        squares = np.einsum("mi,ij,mj->m", residual, self.precision, residual)
        squares[chain.path[a] != chain.path[b]] = residual.shape[1]  # how two paths lie is not known
        return np.asarray(-0.5 * (1 + residual.shape[1]) * np.log1p(squares) - self.log_scale)


def turns(chain: Chain) -> int:
    """How many of a twist's free axes are rotations."""
    return 1 if len(chain.axes) == 3 else 3


def parallel(chain: Chain, motion: Floats, from_a: Floats, from_b: Floats) -> Floats:
    """Residuals (M, p) of motions between two poses, turned into the world's directions."""
    left = se3.log(se3.inverse(motion) @ se3.inverse(from_a) @ from_b).reshape(-1, 2, 3)
    return np.asarray(np.einsum("nij,nkj->nki", from_b[:, :3, :3], left).reshape(-1, 6)[:, chain.axes])


def _floored(second_moment: Floats) -> Floats:
    values, vectors = np.linalg.eigh(second_moment)
    values = np.maximum(values, max(LEAST_SPREAD * float(values[-1]), 1e-12))
    return np.asarray((vectors * values) @ vectors.T)


def gaussian(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """The log-density (M,) and χ² (M,) of residuals (M, p) with covariances (M, p, p)."""
    factor = root(covariance)
    white = np.linalg.solve(factor, residual[..., None])[..., 0]
    chi2 = np.einsum("mi,mi->m", white, white)
    half_log = np.log(np.einsum("mii->mi", factor)).sum(axis=1) + 0.5 * residual.shape[1] * np.log(2 * np.pi)
    return -0.5 * chi2 - half_log, chi2


FREEDOM = 4.0
"""Of Student's distribution of right loops: their errors have heavier tails than a Gaussian's."""


def student(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """The log-density (M,) of Student's distribution, and χ² (M,), of residuals (M, p) with shapes (M, p, p)."""
    log_density, chi2 = gaussian(residual, covariance)
    size = residual.shape[1]
    norm = gammaln((FREEDOM + size) / 2) - gammaln(FREEDOM / 2) - 0.5 * size * np.log(FREEDOM / 2)
    return log_density + 0.5 * chi2 + norm - 0.5 * (FREEDOM + size) * np.log1p(chi2 / FREEDOM), chi2
