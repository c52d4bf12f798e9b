"""The capped reprojection cost of every candidate of a refined model, on the same observations, and the cheapest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import bdtrc

from hodge_pipeline.types import Bools, Floats, Ints, ModelQuality
from hodge_pipeline.types.text import counted
from hodge_pipeline.types.tracked_model import TrackedModel

FINEST_PX = 0.01
"""Mean error below which a model is exact: no detector locates keypoints better."""
CONTRADICTING_PX = 4.0
"""Mean error at which observations contradict each other: COLMAP filters each that is farther off."""
LEAST_CAP_PX = 4.0
"""COLMAP's own limit (`filter_max_reproj_error`): beyond it an observation is wrong, and how far off tells no more."""
CAP_MEDIANS = 3.0
"""The cap in lowest medians, where that is more: right observations of coarse keypoints are farther off."""
LEAST_PARALLAX_DEG = 1.5
"""COLMAP's own limit (`filter_min_tri_angle`): with less a point can be at any distance."""
POINT_PARAMETERS, POSE_PARAMETERS = 3, 6
"""What a point and a pose take from the 2 n numbers of n observations."""
SAME_COST = 1e-4
"""Relative difference below which two costs are those of one optimum."""
OFF_SHARE, DOUBTFUL_SHARE = 0.5, 0.1
"""Share of an image's observations beyond the cap from which it is off, or in doubt; the first also of all images."""
NAMED_IMAGES = 3
"""Images that a verdict names; the report has them all."""
BY_CHANCE = 1e-4
"""Probability of as many mended observations among all that change sides, were each as likely mended as spoilt."""
SOUND_SHARE = 0.05
"""Share of the observations beyond the cap: sound models have as many wrong ones."""
ENOUGH_SEEN = 500
"""Observations of an image: on so many a gain is told to 1 %, since a pose fits six of the thousand numbers anew."""
_COLUMNS = ("errors_px", "parallaxes_deg", "track_lengths")


@dataclass(frozen=True)
class ReprojectionCost:
    """How well the observations fit one candidate.

    - `px`: the mean reprojection error, each capped at `cap_px`; one that is lost, behind its camera or without the
      parallax it should have counts as the cap. `median_px` likewise.
    - `behind`, `distant`: how many of the `observations` lie behind their camera, or lack parallax.
    - `beyond`: the weighted share that lies beyond the cap; `images_off`: images of which most do; `images_in_doubt`:
      of which a tenth does.
    - `near (observations,)`: which of them lie within the cap.
    """

    px: float
    median_px: float
    cap_px: float
    observations: int
    behind: int
    distant: int
    beyond: float
    images_off: tuple[str, ...]
    images_in_doubt: tuple[str, ...]
    near: Bools = field(compare=False, repr=False)

    @property
    def doubt(self) -> str:
        """Why these poses may be wrong although no candidate fits better; "" where nothing says so."""
        if self.px > (1 + SAME_COST) * CONTRADICTING_PX:  # a mean of that cap rounds up or down
            off = f"tracks contradict each other by {self.px:.3g} px (merged wrongly, or cameras are wrong)"
        elif self.beyond > OFF_SHARE:
            off = f"{self.beyond:.0%} of the observations are more than {self.cap_px:.3g} px off"
        else:
            return ""
        return f"in doubt, since {off}"

    @property
    def images_doubt(self) -> str:
        """Which images may be wrong although the whole fits; "" where none is."""
        if not self.images_off:
            return ""
        return f"in doubt, since most observations of {named(self.images_off)} are more than {self.cap_px:.3g} px off"

    @property
    def is_sound(self) -> bool:
        """Whether no image and hardly any observation is left for another candidate to fit better."""
        return not self.images_off and self.beyond <= SOUND_SHARE and not self.doubt


def costs(inputs: Sequence[ModelQuality], candidates: Sequence[ModelQuality]) -> list[ReprojectionCost]:
    """The cost of the inputs together, then of each candidate, on the inputs' observations of points in two images up.

    An observation of a point in n images weighs (2 n − 3) / 2 n, the share of its numbers that the point leaves to test
    poses. One that most candidates see without parallax does not count; seen so by few, it is `distant` there.
    """
    number = {name: row for row, name in enumerate(dict.fromkeys(n for one in inputs for n in one.image_names))}
    keys, first = np.unique(np.concatenate([_keys(one, number) for one in inputs]), return_index=True)
    given = [np.concatenate([getattr(one, name) for one in inputs])[first] for name in _COLUMNS]
    shared = given[2] > 1
    keys, (*values, track_lengths) = keys[shared], (column[shared] for column in given)
    # models of the same tracks have one array of keypoints
    found, places = [values], dict[tuple[int, tuple[str, ...]], tuple[Ints, Ints]]()
    if len(inputs) == 1:
        places[id(inputs[0].keypoints), inputs[0].image_names] = np.arange(len(keys)), first[shared]
    for one in candidates:
        tracks = id(one.keypoints), one.image_names
        if tracks not in places:
            places[tracks] = np.intersect1d(keys, _keys(one, number), return_indices=True)[1:]
        found.append(_values(one, len(keys), *places[tracks]))
    errors_px, parallaxes_deg = (np.array(column) for column in zip(*found, strict=True))
    weights = 1.0 - POINT_PARAMETERS / (2.0 * track_lengths)
    distant = ~(parallaxes_deg >= LEAST_PARALLAX_DEG)
    informed = distant.mean(axis=0) <= 0.5
    if weights[informed].sum() < 0.5 * weights.sum():  # a scene seen from afar: no observation has more parallax
        informed, distant = np.ones(len(keys), bool), np.zeros_like(distant)
    names = tuple(number)
    return _costs(errors_px[:, informed], distant[:, informed], weights[informed], keys[informed] >> 32, names)


def _costs(
    errors_px: Floats, distant: Bools, weights: Floats, image: Ints, names: Sequence[str]
) -> list[ReprojectionCost]:
    """The costs of C candidates by `errors_px`, `distant (C, N)` of N observations, of the images `image (N,)`."""
    if not len(weights):
        nan = float("nan")
        return [ReprojectionCost(nan, nan, nan, 0, 0, 0, 1.0, (), (), np.zeros(0, bool)) for _ in errors_px]
    behind = np.isinf(errors_px)
    effective = np.where(distant | behind, np.inf, errors_px)
    medians = np.median(effective, axis=1)
    cap_px = max(LEAST_CAP_PX, CAP_MEDIANS * float(medians.min())) if np.isfinite(medians).any() else LEAST_CAP_PX
    total = np.bincount(image, minlength=len(names))
    out = []
    for row, errors in enumerate(effective):
        beyond = errors > cap_px
        share = np.bincount(image, beyond, minlength=len(names)) / np.maximum(total, 1)
        capped = np.minimum(errors, cap_px)
        out.append(
            ReprojectionCost(
                px=float(weights @ capped / weights.sum()),
                median_px=float(min(medians[row], cap_px)),
                cap_px=cap_px,
                observations=len(weights),
                behind=int(behind[row].sum()),
                distant=int((distant[row] & ~behind[row]).sum()),
                beyond=float(weights @ beyond / weights.sum()),
                images_off=tuple(name for name, one in zip(names, share.tolist(), strict=True) if one > OFF_SHARE),
                images_in_doubt=tuple(n for n, one in zip(names, share.tolist(), strict=True) if one > DOUBTFUL_SHARE),
                near=~beyond,
            )
        )
    return out


def mends(before: ReprojectionCost, after: ReprojectionCost) -> bool:
    """Whether a candidate brings more observations within the cap than it takes beyond it, by more than chance would,
    and puts no image off; both of the same `costs`.
    """
    if set(after.images_off) - set(before.images_off):
        return False
    mended, spoilt = int((after.near & ~before.near).sum()), int((before.near & ~after.near).sum())
    return mended > spoilt and bool(bdtrc(mended - 1, mended + spoilt, 0.5) < BY_CHANCE)


def spoilt_doubt(before: ReprojectionCost, after: ReprojectionCost) -> str:
    """Why a candidate of lower cost may be wrong: it takes more observations beyond the cap than sound models have
    there, as where half of a scene is laid on a copy of itself; "" where it does not. Both of the same `costs`.
    """
    share = float((before.near & ~after.near).mean()) if len(before.near) else 0.0
    if share <= SOUND_SHARE:
        return ""
    return (
        f"in doubt, since {share:.0%} of the observations, which fit the input, are more than {after.cap_px:.3g} px off"
    )


def degrees_of_freedom(model: TrackedModel, *, with_poses: bool = True) -> int:
    """The numbers observed less the parameters of the points and, `with_poses`, of the bodies' poses."""
    poses = POSE_PARAMETERS * len(model.body_names) if with_poses else 0
    return 2 * len(model.quality.errors_px) - POINT_PARAMETERS * model.quality.points - poses


def named(images: Sequence[str]) -> str:
    """How many images, and the first of their names."""
    shown = ", ".join(images[:NAMED_IMAGES]) + ", …" * (len(images) > NAMED_IMAGES)
    return f"{counted(len(images), 'image')} ({shown})"


def best(found: Sequence[ReprojectionCost]) -> int:
    """The row of the lowest cost, the first of those of the same optimum; 0 where no cost is finite."""
    px = np.array([cost.px for cost in found])
    return int(np.flatnonzero(px <= (1 + SAME_COST) * np.nanmin(px))[0]) if np.isfinite(px).any() else 0


def _keys(quality: ModelQuality, number: dict[str, int]) -> Ints:
    """A key (N,) for each observation: the image in the upper 32 bits, COLMAP's keypoint below; −1 of other images."""
    image = np.array([number.get(name, -1) for name in quality.image_names], np.int64)[quality.keypoints[:, 0]]
    return np.asarray(np.where(image < 0, -1, (image << 32) + quality.keypoints[:, 1]), np.int64)


def _values(quality: ModelQuality, count: int, rows: Ints, own_rows: Ints) -> list[Floats]:
    """Errors and parallaxes (count,) at these rows, from the candidate's own; infinite and 0 where it lost one."""
    errors_px, parallaxes_deg = np.full(count, np.inf), np.zeros(count)
    errors_px[rows], parallaxes_deg[rows] = quality.errors_px[own_rows], quality.parallaxes_deg[own_rows]
    return [errors_px, parallaxes_deg]
