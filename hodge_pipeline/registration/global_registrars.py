"""Registration of two clouds with no guess: FPFH matches, and who decides which of them are right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.registration.consensus import rigid_consensus
from hodge_pipeline.types import Floats, Ints, Match, PointCloud

if TYPE_CHECKING:
    from hodge_pipeline.registration.global_features import DescribedCloud

TOLERANCE_VOXELS = 1.5
MOST_POINTS = 12_000
"""Of a cloud at one of several scales: beyond it two take a second to match, and a coarser scale serves."""
FEWEST_KISS_VOXELS = 200
KISS_RADIUS_VOXELS, FEWEST_KISS_NEIGHBOURS = 3.0, 5
"""KISS-Matcher brings the process down where its own down-sampling leaves it too few points with a neighbourhood."""
MOST_KISS_VOXELS_ACROSS = 100_000
"""Nor may the number of a voxel be larger than it counts to."""
_VOXEL = "metres: the scale of the features. 0.05 serves rooms; about 1/60 of a scan's extent elsewhere"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FpfhConsensus:
    """Mutual FPFH matches, judged by how many others keep their distances: the same every time.

    At each of the `scales` the best motion and its rival are found; what the clouds show decides between them.
    """

    voxel_m: float = Field(default=0.05, gt=0, description=_VOXEL)
    scales: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(1.0, 2.0, 4.0),
        min_length=1,
        description="factors on voxel_m: a scanner's noise and rings hide small shapes, low overlap the large ones",
    )

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        """The features of a cloud, coarser ones beside them."""
        *finer, coarsest = (factor * self.voxel_m for factor in self.scales)
        levels = [*(_describe(cloud, voxel_m, MOST_POINTS) for voxel_m in finer), _describe(cloud, coarsest)]
        return replace(levels[0], coarser=tuple(levels[1:]))

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        """Where the source lies in the target: the motion that leads its rival most, the others beside it."""
        found: list[Match] = []
        levels = zip((target, *target.coarser), (source, *source.coarser), self.scales, strict=True)
        for level_i, level_j, factor in levels:
            rows = _mutual_matches(level_i, level_j)
            tolerance_m = TOLERANCE_VOXELS * factor * self.voxel_m
            best = rigid_consensus(level_i.points[rows[:, 0]], level_j.points[rows[:, 1]], tolerance_m)
            found.append(Match(best.i_from_j, best.count, len(rows), best.rival_count))
            if best.rival is not None:
                found.append(Match(best.rival.i_from_j, best.rival_count, len(rows), best.count))
        if len(self.scales) == 1:
            return found[0]
        first, *others = sorted(found, key=lambda one: one.rivals - one.inliers)
        return replace(first, others=tuple(others))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FpfhRansac:
    """open3d's RANSAC over FPFH matches, at its default settings."""

    voxel_m: float = Field(default=0.05, gt=0, description=_VOXEL)
    max_iterations: int = Field(default=100_000, ge=1, description="draws at most; open3d's default")
    seed: int = Field(default=0, ge=0, description="of the draws")

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        """The features of a cloud."""
        return _describe(cloud, self.voxel_m)

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        """Where the source lies in the target."""

        def register(methods: Any, *clouds: Any) -> Any:
            within_m = TOLERANCE_VOXELS * self.voxel_m
            return methods.registration_ransac_based_on_feature_matching(
                *clouds, False, within_m, methods.TransformationEstimationPointToPoint(False), 3,
                [
                    methods.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    methods.CorrespondenceCheckerBasedOnDistance(within_m),
                ],
                methods.RANSACConvergenceCriteria(self.max_iterations, 0.999),
            )  # fmt: skip

        return _by_open3d(register, target, source, self.seed)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FpfhFgr:
    """open3d's Fast Global Registration (Zhou et al., ECCV 2016) over FPFH matches."""

    voxel_m: float = Field(default=0.05, gt=0, description=_VOXEL)
    seed: int = Field(default=0, ge=0, description="of its tuple test")

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        """The features of a cloud."""
        return _describe(cloud, self.voxel_m)

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        """Where the source lies in the target."""

        def register(methods: Any, *clouds: Any) -> Any:
            within_m = TOLERANCE_VOXELS * self.voxel_m
            option = methods.FastGlobalRegistrationOption(maximum_correspondence_distance=within_m)
            return methods.registration_fgr_based_on_feature_matching(*clouds, option)

        return _by_open3d(register, target, source, self.seed)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class KissMatcher:
    """KISS-Matcher (Lim et al., ICRA 2025): needs the package kiss-matcher (`pip install hodge-pipeline[kiss]`)."""

    voxel_m: float = Field(default=0.05, gt=0, description=_VOXEL)

    def describe(self, cloud: PointCloud) -> Any:
        """The points (N, 3) of a cloud about an origin, and that: its own, or a corner of far coordinates."""
        _kiss_matcher()
        points = np.asarray(cloud.points_in_cam, float)
        points = points[np.isfinite(points).all(axis=1)]
        if not _has_surface(points, self.voxel_m):
            points = np.zeros((0, 3))
        far = np.abs(points).max(initial=0) > MOST_KISS_VOXELS_ACROSS * self.voxel_m
        corner = points.min(axis=0) if far else np.zeros(3)
        return np.ascontiguousarray(points - corner, np.float32), corner

    def match(self, target: Any, source: Any) -> Match:
        """Where the source lies in the target."""
        (target, target_corner), (source, source_corner) = target, source
        if not (len(target) and len(source)):
            return Match(np.eye(4), 0, 0)
        library = _kiss_matcher()
        matcher = library.KISSMatcher(library.KISSMatcherConfig(self.voxel_m))
        found = matcher.estimate(source, target)
        rotation = np.asarray(found.rotation, float)
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation, np.asarray(found.translation, float).reshape(3)
        matches = len(matcher.get_initial_correspondences())
        if not found.valid or not se3.is_motion(motion):
            return Match(np.eye(4), 0, matches)
        rotation = se3.project_to_so3(rotation)
        shift = motion[:3, 3] + target_corner - rotation @ source_corner
        return Match(se3.from_parts(rotation, shift), int(matcher.get_num_final_inliers()), matches)


def _has_surface(points: Floats, voxel_m: float) -> bool:
    """Whether enough voxels of these points (N, 3) have neighbours within the radius that features look at."""
    from scipy.spatial import cKDTree

    if not len(points) or np.ptp(points, axis=0).max() > MOST_KISS_VOXELS_ACROSS * voxel_m:
        return False
    voxels = np.unique(np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64), axis=0)
    near = cKDTree(voxels).query_ball_point(voxels, KISS_RADIUS_VOXELS, return_length=True)
    return int((near > FEWEST_KISS_NEIGHBOURS).sum()) >= FEWEST_KISS_VOXELS


def _kiss_matcher() -> Any:
    try:
        import kiss_matcher
    except ImportError as error:
        raise RecipeError(
            "registrar kiss_matcher needs the package kiss-matcher: pip install kiss-matcher, or take fpfh_consensus"
        ) from error
    return kiss_matcher


def _describe(cloud: PointCloud, voxel_m: float, most_points: float = np.inf) -> DescribedCloud:
    from hodge_pipeline.registration.global_features import describe

    return describe(cloud, voxel_m, most_points)


def _mutual_matches(target: DescribedCloud, source: DescribedCloud) -> Ints:
    from hodge_pipeline.registration.global_features import mutual_matches

    return mutual_matches(target, source)


def _by_open3d(register: Callable[..., Any], target: DescribedCloud, source: DescribedCloud, seed: int) -> Match:
    """What a method of open3d, given its module, two clouds and their features, finds with this seed."""
    if not len(target) or not len(source):
        return Match(np.eye(4), 0, 0)
    from hodge_pipeline.registration.one_thread import o3d

    o3d.utility.random.seed(seed)
    clouds = source.geometry, target.geometry, source.open3d_features, target.open3d_features
    found = register(o3d.pipelines.registration, *clouds)
    motion: Floats = np.asarray(found.transformation, float)
    if not se3.is_motion(motion) or not len(found.correspondence_set):
        return Match(np.eye(4), 0, len(source))
    motion = se3.from_parts(se3.project_to_so3(motion[:3, :3]), motion[:3, 3])
    return Match(motion, len(found.correspondence_set), len(source))
