"""Registration by colour where there is texture, by surfaces where there is none.

Surfaces alone slide where both frames look at one plane, and are biased where they share little; landmarks do neither,
if depth and colour are calibrated to each other. Measured on TUM fr1/rpy, poses from landmarks end at a third of the
error of poses from surfaces, and the mean of both, however weighted, in between: so a pair has one or the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MIN_POINTS, SAME_FITNESS, Assessment, unregistered
from hodge_pipeline.registration.descriptors import match, root_sift
from hodge_pipeline.registration.gicp import Gicp, PreparedCloud
from hodge_pipeline.registration.visual import VisualMotion, visual_motion
from hodge_pipeline.types import Floats, Floats32, Ints, Landmarks, PointCloud, Registration

ASSESSED_POINTS = 1000
"""Points of j whose share near i is the fitness: its standard error is 1.6 % at most."""
MATCHES_PER_SAMPLE = 75.0
"""Matches that count as one independent measurement: they share the errors of lens, shutter and the delay between depth
and colour. Calibrated on real pairs, as `points_per_sample`."""

GUIDED_RATIO = 0.9
"""Lowe's ratio for guided matching, where the second nearest descriptor is one of the neighbourhood."""
FAR = 9.0
"""Above any squared distance of unit descriptors, which is 4 at most."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Rgbd:
    """Landmarks where a pair has them, else plane-to-plane ICP from the guess; needs `clouds.landmarks`."""

    measure: Literal["landmarks", "surfaces"] = Field(
        default="landmarks",
        description="landmarks: theirs is the motion; surfaces: the landmarks only give the start of ICP, for a "
        "camera whose depth and colour are not calibrated to each other, as that of 7-Scenes",
    )
    geometry: Gicp = Field(
        default=Gicp(points_per_sample=1000.0),
        description="ICP where landmarks do not suffice; beside them its own errors are not noise but bias, so more "
        "points count as one measurement than where it is alone",
    )
    near: Gicp = Field(
        default=Gicp(distances_m=(0.1, 0.05), source_points=(2000, 4000)),
        description="ICP from the landmarks' motion, which is good to centimetres, where surfaces are measured",
    )
    min_fitness: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="share of cloud j with a point of cloud i nearby; below it ICP alone is not believed",
    )
    ratio: float = Field(
        default=0.8, gt=0, le=1, description="a match is this much nearer than the second nearest (Lowe 2004: 0.8)"
    )
    min_inliers: int = Field(
        default=15, ge=8, description="matches that must agree on one motion; unrelated frames have at most about 8"
    )
    guided_m: float = Field(
        default=0.15,
        ge=0,
        description="metres: where too few matches agree, landmarks are matched again with those alone that lie this "
        "near where the guess puts them, else surfaces do, which tells the handles of a cabinet apart; 0: they are not",
    )
    assessed_within_m: float = Field(
        default=0.05, gt=0, description="metres: points of j this near to one of i count in the fitness of landmarks"
    )
    seed: int = Field(default=0, ge=0, description="of the consensus; the recipe's seed, where none is given")

    def prepare(self, cloud: PointCloud) -> PreparedFrame:
        """Trees and covariances of the cloud and the landmarks' descriptors, each made when it is first needed."""
        return PreparedFrame(cloud, self.geometry.neighbours, seed=self.seed)

    def register(self, target: PreparedFrame, source: PreparedFrame, i_from_j: Floats) -> Registration:
        """Frame j (source) moved onto frame i (target); the guess is needed where landmarks do not suffice."""
        pairs = match(target.descriptors, source.descriptors, self.ratio)
        visual = self._visual(target, source, pairs)
        guessed = not self._suffices(visual)
        if guessed:
            hint, visual = visual, self._guided(target, source, [i_from_j, *([visual.i_from_j] if visual else [])])
            if visual is None and not self._in_reach(target, source, i_from_j):
                return unregistered(i_from_j)
            if visual is None:
                found = self._by_surfaces(target, source, i_from_j, hint)
                visual = self._guided(target, source, [found.i_from_j])
                if visual is None:
                    return found if found.fitness >= self.min_fitness else unregistered(found.i_from_j)
        assert visual is not None
        if self.measure == "surfaces":
            return self.near.register(target, source, visual.i_from_j)
        return replace(self._by_landmarks(target, source, visual), iterations=int(guessed))

    def _visual(self, target: PreparedFrame, source: PreparedFrame, pairs: Ints) -> VisualMotion | None:
        i, j = pairs.T
        pixels_rad = target.pixel_rad[i], source.pixel_rad[j]
        found = visual_motion(target.landmarks[i], source.landmarks[j], pixels_rad, self.seed)
        return found and replace(found, information=found.information / MATCHES_PER_SAMPLE)

    def _suffices(self, visual: VisualMotion | None) -> bool:
        return visual is not None and visual.inliers >= self.min_inliers

    def _guided(self, target: PreparedFrame, source: PreparedFrame, starts: Sequence[Floats]) -> VisualMotion | None:
        """The motion of most inliers by guided matching from the starts; None with few, or where surfaces disagree."""
        found = [
            self._visual(target, source, guided_match(target, source, start, self.guided_m))
            for start in starts
            if self.guided_m > 0
        ]
        best = max(filter(self._suffices, found), key=lambda one: one.inliers if one else 0, default=None)
        if best is None or self._by_landmarks(target, source, best).fitness < self.min_fitness:
            return None
        return best

    def _in_reach(self, target: PreparedFrame, source: PreparedFrame, i_from_j: Floats) -> bool:
        """Whether enough points of j lie within ICP's coarsest distance of i at the guess to reach `min_fitness`."""
        if min(len(target), len(source)) < MIN_POINTS:
            return False
        return self._within(target, source, i_from_j, max(self.geometry.distances_m)).fitness >= self.min_fitness

    def _by_landmarks(self, target: PreparedFrame, source: PreparedFrame, visual: VisualMotion) -> Registration:
        """The landmarks' motion with its fitness, the larger of both directions where that of j in i is too low: all of
        a close-up i lies in a wide view j, but little of j in i.
        """
        found = self._assessed(target, source, visual)
        if found.fitness >= self.min_fitness:
            return found
        back = self._within(source, target, se3.inverse(found.i_from_j), self.assessed_within_m)
        return replace(found, fitness=max(found.fitness, back.fitness))

    def _by_surfaces(
        self, target: PreparedFrame, source: PreparedFrame, i_from_j: Floats, hint: VisualMotion | None
    ) -> Registration:
        """ICP from the guess; its mean with the few landmarks of `hint`, weighted by information, where that fits the
        surfaces as well: surfaces that slide have no information along themselves.
        """
        found = self.geometry.register(target, source, i_from_j)
        if hint is None or found.correspondences == 0:
            return found
        mean = replace(self._assessed(target, source, _mean_motion(found, hint)), by_landmarks=False)
        return mean if mean.fitness >= found.fitness - SAME_FITNESS else found

    def _within(self, target: PreparedFrame, source: PreparedFrame, i_from_j: Floats, distance_m: float) -> Assessment:
        return target.assess(source, source.sample_rows(ASSESSED_POINTS), i_from_j, distance_m, 1.0)

    def _assessed(self, target: PreparedFrame, source: PreparedFrame, visual: VisualMotion) -> Registration:
        """The landmarks' motion with what the clouds say of it: a false one shows in the fitness."""
        seen = self._within(target, source, visual.i_from_j, self.assessed_within_m)
        return Registration(
            i_from_j=visual.i_from_j,
            information=visual.information,
            fitness=seen.fitness,
            rmse_m=seen.rmse_m,
            correspondences=max(seen.correspondences, visual.inliers),
            iterations=1,
            converged=True,
            by_landmarks=True,
        )


def _mean_motion(surfaces: Registration, landmarks: VisualMotion) -> VisualMotion:
    """The mean of both motions by their information, to first order, with the sum of the information."""
    total = surfaces.information + landmarks.information
    apart = se3.log(se3.inverse(surfaces.i_from_j) @ landmarks.i_from_j)
    step = np.linalg.solve(total + 1e-9 * np.trace(total) * np.eye(6), landmarks.information @ apart)
    return replace(landmarks, i_from_j=surfaces.i_from_j @ se3.exp(step), information=total)


class PreparedFrame(PreparedCloud):
    """A prepared cloud and the frame's landmarks."""

    def __init__(self, cloud: PointCloud, neighbours: int, seed: int) -> None:
        super().__init__(cloud, neighbours, seed=seed)
        landmarks = cloud.landmarks or Landmarks.none()
        self.landmarks = np.asarray(landmarks.points_in_cam, np.float64)
        self.descriptors = root_sift(np.asarray(landmarks.descriptors))
        self.pixel_rad = np.asarray(landmarks.pixel_rad, np.float64)


class WithLandmarks(Protocol):
    """A frame's landmarks (n, 3) in its axes, and their unit descriptors (n, 128)."""

    landmarks: Floats
    descriptors: Floats32


def guided_match(target: WithLandmarks, source: WithLandmarks, i_from_j: Floats, within_m: float) -> Ints:
    """Rows (M, 2) of landmarks of i and j that are each other's nearest by descriptor among those within `within_m`.

    Near a guess a landmark must stand out among its neighbours alone, so that repeated and faint ones match as well.
    """
    if not len(target.landmarks) or not len(source.landmarks):
        return np.zeros((0, 2), np.int64)
    moved = se3.transform(i_from_j, source.landmarks)
    squares = [(points**2).sum(axis=1) for points in (target.landmarks, moved)]
    squared = squares[0][:, None] + squares[1] - 2.0 * target.landmarks @ moved.T
    unlike = np.where(squared < within_m**2, 2.0 - 2.0 * (target.descriptors @ source.descriptors.T), FAR)
    of_source = unlike.argmin(axis=0)
    columns = np.arange(len(of_source))
    nearest = unlike[of_source, columns]
    mutual = (unlike.argmin(axis=1)[of_source] == columns) & (nearest < FAR)
    unlike[of_source, columns] = FAR
    stands_out = nearest < GUIDED_RATIO**2 * unlike.min(axis=0)
    kept = np.flatnonzero(mutual & stands_out)
    return np.stack([of_source[kept], kept], axis=1).astype(np.int64)
