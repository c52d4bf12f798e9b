"""What speaks for a loop: the density of its residual if it is right, against that if it joins places at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from hodge_pipeline import se3
from hodge_pipeline.complex.judging import FREEDOM
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.fit import root
from hodge_pipeline.types import Bools, Floats, Ints

PAIRS, FEWEST_PAIRS = 4000, 200
"""Random pairs of positions that say how far apart places lie; of fewer, any two are taken instead."""


@dataclass(frozen=True)
class Wrong:
    """The residual of a loop between two places at random: a Cauchy distribution of a shape (p, p) in axes that are
    parallel to the world's and begin at the loop's later end.

    `spread (B, p)` and `axes (B, p, p)`, in columns: the eigenvalues and eigenvectors of the shape, for places that are
    so many steps apart, in octaves; the last of any two.
    """

    spread: Floats
    axes: Floats

    @classmethod
    def of(cls, chain: Chain, poses: Floats) -> Wrong:
        """As the motions of the loops are between random positions of one path."""
        rng = np.random.default_rng(0)
        pairs = rng.integers(0, chain.size, (PAIRS, 2))
        shapes = [_shape(chain, poses, pairs[_on_one_path(chain, pairs)], rng)]
        for octave in reversed(range(int(np.log2(max(chain.size, 2))))):
            pairs[:, 1] = pairs[:, 0] + rng.integers(2**octave, 2 ** (octave + 1), PAIRS)
            near = pairs[_on_one_path(chain, pairs)]
            shapes.append(_shape(chain, poses, near, rng) if len(near) >= FEWEST_PAIRS else shapes[0])
        return cls(*np.linalg.eigh(np.stack(shapes[::-1])))

    def at(self, chain: Chain, rows: Ints, residual: Floats) -> WrongLoops:
        """Where these loops (K,) with residuals (K, p) end if they are wrong."""
        a, b = chain.ends[rows].T
        apart = chain.path[a] != chain.path[b]
        octave = np.minimum(np.log2(np.maximum(b - a, 1)).astype(np.int64), len(self.spread) - 1)
        octave[apart] = len(self.spread) - 1
        along = np.swapaxes(self.axes, 1, 2)[octave]
        return WrongLoops(along, self.spread[octave], (along @ residual[:, :, None])[..., 0] ** 2, apart)


@dataclass(frozen=True)
class WrongLoops:
    """Residuals of loops if these are wrong, squared (K, p), and the `spread (K, p)` of their distribution, `along
    (K, p, p)` its axes, in rows; `apart (K,)`: between two paths.
    """

    along: Floats
    spread: Floats
    squared: Floats
    apart: Bools

    def log_density(self, covariance: Floats) -> Floats:
        """Where right loops have such covariances (K, p, p): along an axis in which places hardly differ a wrong loop
        is as far off as a right one.
        """
        shape = np.maximum(self.spread, np.einsum("kij,kij->ki", self.along @ covariance, self.along))
        chi2, size = (self.squared / shape).sum(axis=1), shape.shape[1]
        chi2[self.apart] = size  # how two paths lie is not known
        return np.asarray(log_student(chi2, size, freedom=1.0) - 0.5 * np.log(shape).sum(axis=1))


def _on_one_path(chain: Chain, pairs: Ints) -> Bools:
    """Pairs (K, 2) of positions, the second of which may lie beyond the last, of one path."""
    second = np.minimum(pairs[:, 1], chain.size - 1)
    return np.asarray((second == pairs[:, 1]) & (chain.path[pairs[:, 0]] == chain.path[second]))


def _shape(chain: Chain, poses: Floats, pairs: Ints, rng: np.random.Generator) -> Floats:
    """The spread (p, p) of the residuals of loops between other positions (K, 2)."""
    motion = chain.motion[rng.integers(0, len(chain.motion), len(pairs))]
    residual = parallel(chain, motion, poses[pairs[:, 0]], poses[pairs[:, 1]])
    moment, split = residual.T @ residual / max(len(residual), 1), chain.turns
    shape = np.zeros_like(moment)
    shape[:split, :split], shape[split:, split:] = moment[:split, :split], moment[split:, split:]
    return shape


def parallel(chain: Chain, motion: Floats, from_a: Floats, from_b: Floats) -> Floats:
    """Residuals (M, p) of motions between two poses, turned into the world's directions."""
    turned = se3.from_parts(from_b[:, :3, :3], np.zeros(3))
    left = chain.log(chain.between(motion, chain.between(from_a, from_b)))
    return np.asarray(np.einsum("nij,nj->ni", chain.adjoint(turned), left))


def squares(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """χ² (M,) of residuals (M, p) with covariances (M, p, p), and half the logarithms (M,) of their determinants."""
    factor, white = root(covariance), np.empty_like(residual)
    for row in range(residual.shape[1]):  # by substitution, for all at once
        above = np.einsum("mk,mk->m", factor[:, row, :row], white[:, :row])
        white[:, row] = (residual[:, row] - above) / factor[:, row, row]
    return np.einsum("mi,mi->m", white, white), np.log(np.einsum("mii->mi", factor)).sum(axis=1)


def student(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """The log-density (M,) of Student's distribution, and χ² (M,), of residuals (M, p) with shapes (M, p, p)."""
    chi2, half_log_det = squares(residual, covariance)
    return log_student(chi2, residual.shape[1]) - half_log_det, chi2


def log_student(chi2: Floats | float, size: int, freedom: float = FREEDOM) -> Floats:
    """The log-density of Student's distribution in so many dimensions, in units of its shape's roots: with a freedom of
    one that of Cauchy's.
    """
    norm = gammaln((freedom + size) / 2) - gammaln(freedom / 2) - 0.5 * size * np.log(freedom * np.pi)
    return np.asarray(norm - 0.5 * (freedom + size) * np.log1p(np.asarray(chi2) / freedom))


EVEN, LEAST_SHARE = np.full(2, 0.5), 1e-3
"""The shares of right and wrong loops before any is looked at, and the least that a class is given."""


LARGEST = 700.0
"""Nats beyond which a loop is right with any share: their exponential is a number yet."""


def mixture(factor: Floats) -> tuple[Floats, float]:
    """The shares of right and wrong loops that are likeliest with these log Bayes factors (M,), half a loop of each
    counted beforehand; and the log-likelihood of the loops then, against all being wrong.
    """
    from scipy.optimize import brentq  # which takes .1 s, and not every graph needs it

    gain = np.expm1(np.minimum(factor, LARGEST))

    def slope(right: float) -> float:  # of the log-likelihood, which is concave
        return float((gain / (1 + right * gain)).sum()) + 0.5 / right - 0.5 / (1 - right)

    least, most = LEAST_SHARE, 1 - LEAST_SHARE
    right = least if slope(least) <= 0 else most if slope(most) >= 0 else brentq(slope, least, most, xtol=1e-6)
    return np.array([right, 1 - right]), float(np.logaddexp(np.log(right) + factor, np.log1p(-right)).sum())
