"""Absolute (ATE) and relative (RPE) error of an estimated trajectory against a reference (Sturm et al. 2012).

Frames whose estimate or reference is not finite (NaN: no truth) are left out and counted. Each connected component has
a gauge of its own, so each is aligned by itself, and no relative motion is taken between two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.arrays import rms

COLLINEAR = 1e-6
"""Second singular value over the first of the positions' covariance, below which positions leave a roll open."""
ORIENTATION_SHARE = 1e-6
"""Weight of the orientations where positions leave a rotation open: small, so that positions decide what they can."""
ASSOCIATED_S = 0.01
"""Seconds at most between a pose and its reference: evo's default."""


@dataclass(frozen=True)
class Alignment:
    """The similarity `p_reference = scale · R p_estimate + t`; `reference_from_estimate (4, 4)` holds R and t.

    `degenerate`: positions left a rotation open, which the orientations then decided.
    """

    reference_from_estimate: Floats
    scale: float
    degenerate: bool

    def apply(self, world_from_cam: Floats) -> Floats:
        """Poses (..., 4, 4) of the estimate moved into the reference's world."""
        return np.asarray(self.reference_from_estimate @ se3.rescaled(world_from_cam, self.scale))


def align(estimate: Floats, reference: Floats, with_scale: bool = False) -> Alignment:
    """The similarity, or rigid motion, with the least squared distances of positions of poses (N, 4, 4) (Umeyama 1991).

    Fewer than three poses, or positions on a line, leave a rotation open: the orientations decide it (`degenerate`).
    """
    x, y = estimate[:, :3, 3], reference[:, :3, 3]
    centre_x, centre_y = x.mean(axis=0), y.mean(axis=0)
    covariance = (y - centre_y).T @ (x - centre_x) / len(x)
    singular = np.linalg.svd(covariance, compute_uv=False)
    degenerate = bool(singular[1] <= COLLINEAR * singular[0])
    mixed = covariance + _orientation_term(estimate, reference, singular[0]) if degenerate else covariance
    rotation = se3.project_to_so3(mixed)
    variance = np.sum((x - centre_x) ** 2) / len(x)
    scale = float(np.trace(rotation.T @ covariance) / variance) if with_scale and variance > 0 else 1.0
    return Alignment(se3.from_parts(rotation, centre_y - scale * rotation @ centre_x), scale, degenerate)


def _orientation_term(estimate: Floats, reference: Floats, size: float) -> Floats:
    """What the orientations add to the covariance (3, 3) of positions, whose first singular value is `size`."""
    turns = reference[:, :3, :3] @ np.swapaxes(estimate[:, :3, :3], -1, -2)
    return np.asarray(ORIENTATION_SHARE * (size if size > 0 else 1.0) * turns.mean(axis=0))


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error after alignment: of so many `frames`, others `left_out`.

    `per_frame_m (N,)` and `aligned (N, 4, 4)`, the estimate in the reference's world, are NaN where left out;
    `alignments` has one for each component.
    """

    rmse_m: float
    median_m: float
    max_m: float
    frames: int
    left_out: int
    per_frame_m: Floats
    aligned: Floats
    alignments: tuple[Alignment, ...]


def absolute_error(
    estimate: Floats, reference: Floats, component: Ints | None = None, *, with_scale: bool = False
) -> AbsoluteError:
    """The distances of the positions of poses (N, 4, 4) from their reference, each component aligned by itself.

    `component (N,)` labels the frames that share a gauge; one component by default. Raises `GraphError` for unequal
    numbers of poses.
    """
    usable = _usable(estimate, reference)
    labels = np.zeros(len(estimate), np.int64) if component is None else np.asarray(component)
    aligned = np.full((len(estimate), 4, 4), np.nan)
    alignments = []
    for label in np.unique(labels[usable]):
        rows = np.flatnonzero(usable & (labels == label))
        alignments.append(align(estimate[rows], reference[rows], with_scale))
        aligned[rows] = alignments[-1].apply(estimate[rows])
    per_frame_m = np.linalg.norm(aligned[:, :3, 3] - reference[:, :3, 3], axis=-1)
    known = per_frame_m[usable]
    median, largest = (np.median(known), known.max()) if len(known) else (np.nan,) * 2
    return AbsoluteError(
        rmse_m=rms(known),
        median_m=float(median),
        max_m=float(largest),
        frames=int(usable.sum()),
        left_out=int((~usable).sum()),
        per_frame_m=per_frame_m,
        aligned=aligned,
        alignments=tuple(alignments),
    )


def associate(stamps_a: Floats, stamps_b: Floats, most_s: float = ASSOCIATED_S) -> tuple[Ints, Ints]:
    """Rows (M,) of two lists of ascending stamps that belong together, by evo's rule.

    Each stamp of the shorter list is paired with the nearest of the longer one, if it is at most `most_s` away.
    """
    if not len(stamps_a) or not len(stamps_b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows_a, rows_b = np.arange(len(stamps_a)), np.arange(len(stamps_b))
    if len(rows_b) < len(rows_a):
        rows_a = _nearest(stamps_b, stamps_a)
    else:
        rows_b = _nearest(stamps_a, stamps_b)
    near = np.abs(stamps_a[rows_a] - stamps_b[rows_b]) <= most_s
    return rows_a[near], rows_b[near]


def _nearest(moments: Floats, among: Floats) -> Ints:
    """The row of the nearest stamp (among: ascending) to each moment."""
    after = np.clip(np.searchsorted(among, moments), 0, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(among[before] - moments) <= np.abs(among[after] - moments), before, after)


def _usable(estimate: Floats, reference: Floats) -> Bools:
    """Frames (N,) with a finite pose in both. Raises `GraphError` for unequal numbers of poses."""
    if estimate.shape != reference.shape:
        raise GraphError(f"{len(estimate)} poses against {len(reference)} reference poses: associate them first")
    return np.asarray(se3.has_pose(estimate) & se3.has_pose(reference))


@dataclass(frozen=True)
class RelativeError:
    """RMS of the relative pose error over `delta_frames`; NaN where no pair of frames can be compared."""

    delta_frames: int
    translation_rmse_m: float
    rotation_rmse_deg: float


def relative_error(
    estimate: Floats, reference: Floats, delta_frames: int = 1, component: Ints | None = None
) -> RelativeError:
    """RMS error of the motions from each frame k to l = k + delta: `(B_k⁻¹ B_l)⁻¹ (A_k⁻¹ A_l)`, B the reference.

    `component (N,)` labels frames that share a gauge (or a sequence): no motion is taken across two labels.
    """
    if delta_frames < 1:
        raise ValueError(f"delta_frames is {delta_frames}: a motion needs at least one frame")
    usable = _usable(estimate, reference)
    start = np.arange(max(len(estimate) - delta_frames, 0))
    same = np.ones(len(start), bool) if component is None else component[start] == component[start + delta_frames]
    chosen = start[usable[start] & usable[start + delta_frames] & same]
    motion = se3.inverse(estimate[chosen]) @ estimate[chosen + delta_frames]
    true_motion = se3.inverse(reference[chosen]) @ reference[chosen + delta_frames]
    error = se3.inverse(true_motion) @ motion
    translation_m = np.linalg.norm(error[:, :3, 3], axis=-1)
    return RelativeError(delta_frames, rms(translation_m), rms(np.rad2deg(se3.rotation_angle(error))))
