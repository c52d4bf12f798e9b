"""The focal length that the reprojection errors of tracked frames tell, to check the camera's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.tracking.readout import FEWEST_KEYS, INTERVAL, drawn_keys, with_readout
from hodge_pipeline.registration.tracking.reposing import view_at_stamps
from hodge_pipeline.registration.tracking.resection import focal_evidence, resect
from hodge_pipeline.registration.tracking.sightings import views
from hodge_pipeline.types import Camera, Floats, Frame
from hodge_pipeline.types.arrays import evenly, groups

MOST_VIEWS = 50
"""Views used, evenly spread: each takes 8 CPU ms."""
ROUNDS = 3
"""Gauss–Newton steps on log f: with a focal length 25 % off the last one moves it by 2 %."""
OTHER = 0.07
"""Of log f: a right camera may be so far off where depth and colour are not calibrated to each other. Of fr1/rpy,
fr1/xyz and two parts of red kitchen 0.02, 0.01, 0.01 and 0.06 are found.
"""


@dataclass(frozen=True)
class Focal:
    """Focal lengths in pixels: the camera's own, that of the best fit, and the ends of its 98 % interval."""

    own: float
    best: float
    low: float
    high: float

    @property
    def is_other(self) -> bool:
        """Whether the camera's own lies outside the interval by more than `OTHER`."""
        return bool(np.log(self.low / self.own) > OTHER or np.log(self.own / self.high) > OTHER)


def estimate_focal(
    sightings: Path,
    frames: Sequence[Frame],
    world_from_cam: Floats,
    twists: Floats,
    readout_s: float | None,
    unit_m: float,
) -> Focal | None:
    """The focal length of least reprojection error in views (a folder of `Sightings`), their poses estimated with it.

    `twists (N, 6)`: see `shutter.velocities`. None where cameras differ, or views are of too few key frames.
    """
    cameras, found = {frame.camera for frame in frames}, list(views(sightings))
    camera = next(iter(cameras))
    chosen = [found[at] for at in evenly(len(found), MOST_VIEWS)]
    keys = groups(np.array([view.key for view in chosen], np.int64))
    if len(cameras) > 1 or camera is None or len(keys) < FEWEST_KEYS:
        return None
    camera = with_readout(camera, readout_s)
    poses = [se3.inverse(world_from_cam[view.key]) @ world_from_cam[view.row] for view in chosen]
    stamped = [view_at_stamps(view, camera, frames, twists, pose) for view, pose in zip(chosen, poses, strict=True)]
    drawn, log = drawn_keys(len(keys)), 0.0
    for _ in range(ROUNDS):
        evidence = _evidence(stamped, poses, camera, log, unit_m)
        of_key = np.array([evidence[rows].sum(axis=0) for _, rows in keys])
        gradient, information = of_key[drawn].sum(axis=1).T
        if not information.all():
            return None
        low, high = camera.fx * np.exp(log + np.quantile(gradient / information, INTERVAL))
        log += float(evidence[:, 0].sum() / evidence[:, 1].sum())
    return Focal(camera.fx, camera.fx * float(np.exp(log)), float(low), float(high))


def _evidence(
    stamped: Sequence[tuple[Floats, Floats]], poses: list[Floats], camera: Camera, log: float, unit_m: float
) -> Floats:
    """`focal_evidence` (V, 2) of each view at exp(log) times the camera's focal length; updates `poses`."""
    evidence = np.zeros((len(stamped), 2))
    tried = replace(camera, fx=camera.fx * np.exp(log), fy=camera.fy * np.exp(log))
    for at, (points, seen) in enumerate(stamped):
        points = points * [np.exp(-log), np.exp(-log), 1.0]
        fit = resect(points, seen, tried, poses[at], unit_m)
        if fit is not None:
            poses[at] = fit.known_from_cam
            evidence[at] = focal_evidence(points, seen, tried, fit.known_from_cam, unit_m)
    return evidence
