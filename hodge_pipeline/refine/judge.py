"""One robust cost for every candidate of a refined model, on the same observations, and which candidate is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import binom

from hodge_pipeline.types import Bools, Floats, Ints, ModelQuality
from hodge_pipeline.types.text import counted

CONTRADICTING_PX = 4.0
"""Mean error at which observations contradict each other: COLMAP leaves out each that is farther off."""
LEAST_CAP_PX = 4.0
"""COLMAP's own limit (`filter_max_reproj_error`): beyond it an observation is wrong, and how far off tells no more."""
CAP_MEDIANS = 3.0
"""Of the lowest median: where the keypoints themselves are coarse, right observations are farther off."""
LEAST_PARALLAX_DEG = 1.5
"""COLMAP's own limit (`filter_min_tri_angle`): with less a point can be at any distance."""
FREE_OF_A_POINT = 3
"""Coordinates that each point takes from the 2 n numbers of its n observations: those tell nothing of the poses."""
SAME_COST = 1e-4
"""Relative: two candidates nearer than this have come to the same optimum."""
OFF_SHARE, DOUBTFUL_SHARE = 0.5, 0.1
"""Of the observations of an image, or of all of them."""
NAMED_IMAGES = 3
"""In a verdict; the report has them all."""
BY_CHANCE = 1e-4
"""Probability that a candidate mends so many more observations than it spoils where each is as likely."""
SOUND_SHARE = 0.05
"""Of the observations beyond the cap: as many are wrong in models that nothing is the matter with."""


@dataclass(frozen=True)
class Cost:
    """What the observations say of one candidate.

    `px`: the mean error, each capped at `cap_px`, where an observation that is lost, behind its camera or without the
    parallax it should have counts as the cap; `median_px` likewise. Of `observations`, so many are `behind`, `distant`
    (without parallax), and the share `beyond` lies beyond the cap; `images_off`: where most do; `images_in_doubt`:
    where a tenth does. `near (observations,)`: which are within the cap.
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
        """Why these poses may be wrong although nothing fits better; empty where nothing says so."""
        if self.px > CONTRADICTING_PX:
            off = f"tracks contradict each other by {self.px:.3g} px (merged wrongly, or cameras are wrong)"
        elif self.beyond > OFF_SHARE:
            off = f"{self.beyond:.0%} of the observations are more than {self.cap_px:.3g} px off"
        else:
            return ""
        return f"in doubt, since {off}"

    @property
    def images_doubt(self) -> str:
        """Which images may be wrong although the whole fits; empty where none is."""
        if not self.images_off:
            return ""
        return f"in doubt, since most observations of {named(self.images_off)} are more than {self.cap_px:.3g} px off"

    @property
    def is_sound(self) -> bool:
        """Whether no image and hardly an observation is left that another candidate could explain."""
        return not self.images_off and self.beyond <= SOUND_SHARE and not self.doubt


def costs(inputs: Sequence[ModelQuality], candidates: Sequence[ModelQuality]) -> list[Cost]:
    """The cost of the inputs together, then of each candidate, on the inputs' observations of points in many images.

    An observation counts by the share of its numbers that a point leaves over, (2 n - 3) / 2 n. One that most
    candidates see without parallax does not count; one that few do is `distant` there.
    """
    number = {name: row for row, name in enumerate(dict.fromkeys(n for one in inputs for n in one.image_names))}
    keys, first = np.unique(np.concatenate([_keys(one, number) for one in inputs]), return_index=True)
    given = [np.concatenate([getattr(one, part) for one in inputs])[first] for part in _PARTS]
    counted = given[2] > 1
    keys, given = keys[counted], [part[counted] for part in given]
    found = [given[:2], *(_values(one, number, keys) for one in candidates)]
    errors_px, parallaxes_deg = (np.array([values[part] for values in found]) for part in range(2))
    weights = 1.0 - FREE_OF_A_POINT / (2.0 * given[2])
    distant = ~(parallaxes_deg >= LEAST_PARALLAX_DEG)
    informed = distant.mean(axis=0) <= 0.5
    if weights[informed].sum() < 0.5 * weights.sum():  # all of it seen from afar: there is nothing better
        informed, distant = np.ones(len(keys), bool), np.zeros_like(distant)
    names = tuple(number)
    return _costs(errors_px[:, informed], distant[:, informed], weights[informed], keys[informed] >> 32, names)


_PARTS = ("errors_px", "parallaxes_deg", "track_lengths")


def _costs(errors_px: Floats, distant: Bools, weights: Floats, image: Ints, names: Sequence[str]) -> list[Cost]:
    if not len(weights):
        nan = float("nan")
        return [Cost(nan, nan, nan, 0, 0, 0, 1.0, (), (), np.zeros(0, bool)) for _ in errors_px]
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
            Cost(
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


def mends(before: Cost, after: Cost) -> bool:
    """Whether a candidate explains observations that were off, so many more than it spoils that chance does not, and
    spoils no image; both of the same `costs`.
    """
    mended, spoilt = int((after.near & ~before.near).sum()), int((before.near & ~after.near).sum())
    if set(after.images_off) - set(before.images_off):
        return False
    return bool(mended > spoilt and binom.sf(mended - 1, mended + spoilt, 0.5) < BY_CHANCE)


def named(images: Sequence[str]) -> str:
    """How many images, and the first of their names."""
    shown = ", ".join(images[:NAMED_IMAGES]) + ", …" * (len(images) > NAMED_IMAGES)
    return f"{counted(len(images), 'image')} ({shown})"


def best(found: Sequence[Cost]) -> int:
    """The row of the lowest cost, the first of those that are the same."""
    px = np.array([cost.px for cost in found])
    return int(np.flatnonzero(px <= (1 + SAME_COST) * np.nanmin(px))[0]) if np.isfinite(px).any() else 0


def _keys(quality: ModelQuality, number: dict[str, int]) -> Ints:
    """One number (N,) for each image and keypoint, -1 of other images; COLMAP's keypoints are numbered by 32 bits."""
    image = np.array([number.get(name, -1) for name in quality.image_names], np.int64)[quality.keypoints[:, 0]]
    return np.asarray(np.where(image < 0, -1, (image << 32) + quality.keypoints[:, 1]), np.int64)


def _values(quality: ModelQuality, number: dict[str, int], keys: Ints) -> tuple[Floats, Floats]:
    """Errors and parallaxes (N,) at these observations; infinite and 0 where the candidate lost one."""
    own = _keys(quality, number)
    _, rows, own_rows = np.intersect1d(keys, own, return_indices=True)
    errors_px, parallaxes_deg = np.full(len(keys), np.inf), np.zeros(len(keys))
    errors_px[rows], parallaxes_deg[rows] = quality.errors_px[own_rows], quality.parallaxes_deg[own_rows]
    return errors_px, parallaxes_deg
