"""Bayes factors of loops: densities of residuals of right loops and of loops that join places at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from hodge_pipeline.complex.chi2 import FREEDOM
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.levels import FEWEST, RANDOM
from hodge_pipeline.solvers.backbone.linear import cholesky, motion_residuals
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.types import Bools, Floats, Ints

BY_CHANCE = float(np.log(100.0))
"""Log-evidence, in nats, that chance reaches in one graph of a hundred."""


@dataclass(frozen=True)
class OutlierModel:
    """The distribution of the residual of a wrong loop, which joins two places at random: a Cauchy distribution, about
    the loop's later end in world axes.

    `spread (B, p)` and `axes (B, p, p)`: eigenvalues of the shape matrix, and eigenvectors in columns, one for each
    octave of the number of steps between the places; the last one for any two.
    """

    spread: Floats
    axes: Floats

    @classmethod
    def of(cls, chain: Chain) -> OutlierModel:
        """Estimated from the loops' motions put between random positions of one path; an octave that hardly any path is
        as long as gets the shape of any two.
        """
        rng = np.random.default_rng(0)
        pairs = rng.integers(0, chain.size, (RANDOM, 2))
        shapes = [_shape(chain, pairs[_on_one_path(chain, pairs)], rng)]
        for octave in reversed(range(int(np.log2(max(chain.size, 2))))):
            pairs[:, 1] = pairs[:, 0] + rng.integers(2**octave, 2 ** (octave + 1), RANDOM)
            near = pairs[_on_one_path(chain, pairs)]
            shapes.append(_shape(chain, near, rng) if len(near) >= FEWEST else shapes[0])
        across, along = _never_contradicted(chain, shapes[0])
        return cls(*np.linalg.eigh(across @ np.stack(shapes[::-1]) @ across + along))

    def at(self, chain: Chain, rows: Ints, residual: Floats) -> OutlierResiduals:
        """The residuals (K, p) of loops `rows (K,)` in the principal axes of their distribution."""
        (a, b), apart = chain.ends[rows].T, chain.apart[rows]
        octave = np.minimum(np.log2(np.maximum(b - a, 1)).astype(np.int64), len(self.spread) - 1)
        octave[apart] = len(self.spread) - 1
        along = np.swapaxes(self.axes, 1, 2)[octave]
        return OutlierResiduals(along, self.spread[octave], (along @ residual[:, :, None])[..., 0] ** 2, apart)


@dataclass(frozen=True)
class OutlierResiduals:
    """Residuals of loops in the principal axes of the outlier distribution.

    `along (K, p, p)`: the axes, in rows; `spread (K, p)`: its variances there; `squared (K, p)`: the squared residuals;
    `apart (K,)`: loops between two paths.
    """

    along: Floats
    spread: Floats
    squared: Floats
    apart: Bools

    def log_density(self, covariance: Floats) -> Floats:
        """The log-density (K,) if the loops are wrong; their spread is no less than the `covariance (K, p, p)` of right
        ones, since along an axis in which places hardly differ a wrong loop is as far off as a right one.
        """
        shape = np.maximum(self.spread, np.einsum("kij,kij->ki", self.along @ covariance, self.along))
        chi2, size = (self.squared / shape).sum(axis=1), shape.shape[1]
        chi2[self.apart] = size  # the relative pose of two paths is unknown
        return np.asarray(log_student(chi2, size, freedom=1.0) - 0.5 * np.log(shape).sum(axis=1))


def _on_one_path(chain: Chain, pairs: Ints) -> Bools:
    """Which pairs (K, 2) of positions lie on one path; a second one may lie beyond the last position."""
    second = np.minimum(pairs[:, 1], chain.size - 1)
    return np.asarray((second == pairs[:, 1]) & (chain.path[pairs[:, 0]] == chain.path[second]))


def _shape(chain: Chain, pairs: Ints, rng: np.random.Generator) -> Floats:
    """The second moment (p, p) of residuals of random loops between these positions (K, 2), without cross terms."""
    motion = chain.motion[rng.integers(0, len(chain.motion), len(pairs))]
    residual = motion_residuals(chain, motion, chain.poses[pairs[:, 0]], chain.poses[pairs[:, 1]])
    moment, split = residual.T @ residual / max(len(residual), 1), chain.rotation_axes
    shape = np.zeros_like(moment)
    shape[:split, :split], shape[split:, split:] = moment[:split, :split], moment[split:, split:]
    return shape


def _never_contradicted(chain: Chain, shape: Floats) -> tuple[Floats, Floats]:
    """The projection (p, p) across the directions of rotation and of translation in which wrong loops agree with the
    chain, and their second moment (p, p) along these; `shape (p, p)`: of random loops.

    Gravity tells the tilt of both ends of a loop, and pressure their depth, whatever place they are taken for: to agree
    in these says nothing. Wrong for certain are loops as far off as random ones; each place of them counts once. Where
    they are off along one line they take floors or rows for each other, which their shift tells: see `mistakes`.
    """
    size, split = len(chain.axes), chain.rotation_axes
    across, along = np.eye(size), np.zeros((size, size))
    a, b = chain.ends.T
    residual = motion_residuals(chain, chain.motion, chain.poses[a], chain.poses[b])
    values, vectors = np.linalg.eigh(shape)
    least = max(float(values.max()) * np.finfo(float).eps, np.finfo(float).tiny)
    whiten = (vectors / np.sqrt(np.maximum(values, least))) @ vectors.T
    off = ((residual @ whiten) ** 2).sum(axis=1)
    far = np.flatnonzero((off >= 1) & ~chain.apart)
    far = far[one_of_each_place(chain.places[far])]
    if len(far) < PLACES_PER_AXIS * size:
        return across, along
    unit = residual[far] @ whiten / np.sqrt(off[far])[:, None]
    for axes in (slice(split, None), slice(0, split)):
        share, ways = np.linalg.eigh(unit[:, axes].T @ unit[:, axes] * size / len(far))
        agreed = share < NEVER_OFF**2
        if axes.stop is None and (~agreed).sum() < 2:
            break
        normals = np.linalg.qr(whiten[axes, axes] @ ways[:, agreed])[0]
        seen = residual[far, axes] @ normals
        across[axes, axes] -= normals @ normals.T
        along[axes, axes] = normals @ (seen.T @ seen / len(far)) @ normals.T
    return across, along


PLACES_PER_AXIS, NEVER_OFF = 5, 0.25
"""Wrong places per axis that tell a direction in which all agree; and how far off they are in it, as a share of random
loops: up to .18 of those of dives; .65 or more in 27 graphs of the literature and simulated ones, but for planes.
"""


def mahalanobis(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Squared Mahalanobis distances (M,) of residuals (M, p), and half the log-determinants (M,) of covariances."""
    factor, white = cholesky(covariance), np.empty_like(residual)
    for row in range(residual.shape[1]):  # by substitution, for all at once
        above = np.einsum("mk,mk->m", factor[:, row, :row], white[:, :row])
        white[:, row] = (residual[:, row] - above) / factor[:, row, row]
    return np.einsum("mi,mi->m", white, white), np.log(np.einsum("mii->mi", factor)).sum(axis=1)


def student_log_density(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Log-density (M,) of Student's t with shapes (M, p, p) at residuals (M, p), and χ² (M,)."""
    chi2, half_log_det = mahalanobis(residual, covariance)
    return log_student(chi2, residual.shape[1]) - half_log_det, chi2


def log_student(chi2: Floats | float, size: int, freedom: float = FREEDOM) -> Floats:
    """Log-density of Student's t of unit shape in `size` dimensions at these χ²; Cauchy's for one degree of freedom."""
    norm = gammaln((freedom + size) / 2) - gammaln(freedom / 2) - 0.5 * size * np.log(freedom * np.pi)
    return np.asarray(norm - 0.5 * (freedom + size) * np.log1p(np.asarray(chi2) / freedom))


EVEN, LEAST_SHARE = np.full(2, 0.5), 1e-3
"""Prior shares of right and wrong loops, and the least share of either."""


LARGEST = 700.0
"""Nats at which factors are clipped, so that their exponential is finite."""


def mixture(factor: Floats) -> tuple[Floats, float]:
    """The most probable shares (2,) of right and wrong loops given log Bayes factors (M,) and the prior Beta(3/2, 3/2);
    and the log-likelihood of the loops, against all being wrong.
    """
    from scipy.optimize import brentq  # which takes .1 s, and not every graph needs it

    gain = np.expm1(np.minimum(factor, LARGEST))

    def slope(right: float) -> float:  # of the log-likelihood, which is concave
        return float((gain / (1 + right * gain)).sum()) + 0.5 / right - 0.5 / (1 - right)

    least, most = LEAST_SHARE, 1 - LEAST_SHARE
    right = least if slope(least) <= 0 else most if slope(most) >= 0 else brentq(slope, least, most, xtol=1e-6)
    return np.array([right, 1 - right]), float(np.logaddexp(np.log(right) + factor, np.log1p(-right)).sum())
