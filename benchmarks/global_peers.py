"""The other registrars with no guess, beside which `benchmarks/unordered.py` puts ours: open3d's two, KISS-Matcher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.global_features import DescribedCloud, describe
from hodge_pipeline.registration.one_thread import o3d
from hodge_pipeline.types import Floats, Match, PointCloud

VOXEL_M, WITHIN_M, RANSAC_DRAWS = 0.05, 0.075, 100_000
"""Ours too; 1.5 voxels; open3d's default."""


@dataclass(frozen=True)
class FpfhRansac:
    """open3d's RANSAC over FPFH matches, at its default settings."""

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        return describe(cloud, VOXEL_M)

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        def register(methods: Any, *clouds: Any) -> Any:
            checks = [
                methods.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                methods.CorrespondenceCheckerBasedOnDistance(WITHIN_M),
            ]
            return methods.registration_ransac_based_on_feature_matching(
                *clouds, False, WITHIN_M, methods.TransformationEstimationPointToPoint(False), 3, checks,
                methods.RANSACConvergenceCriteria(RANSAC_DRAWS, 0.999),
            )  # fmt: skip

        return _by_open3d(register, target, source)


@dataclass(frozen=True)
class FpfhFgr:
    """open3d's Fast Global Registration (Zhou et al., ECCV 2016) over FPFH matches."""

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        return describe(cloud, VOXEL_M)

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        def register(methods: Any, *clouds: Any) -> Any:
            option = methods.FastGlobalRegistrationOption(maximum_correspondence_distance=WITHIN_M)
            return methods.registration_fgr_based_on_feature_matching(*clouds, option)

        return _by_open3d(register, target, source)


@dataclass(frozen=True)
class KissMatcher:
    """KISS-Matcher (Lim et al., ICRA 2025); clouds without surfaces bring the process down in it."""

    def describe(self, cloud: PointCloud) -> Any:
        return np.ascontiguousarray(cloud.points_in_cam, np.float32)

    def match(self, target: Any, source: Any) -> Match:
        import kiss_matcher

        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL_M))
        found = matcher.estimate(source, target)
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = found.rotation, np.asarray(found.translation, float).reshape(3)
        matches = len(matcher.get_initial_correspondences())
        return _rigid(motion, int(matcher.get_num_final_inliers()) if found.valid else 0, matches)


def _by_open3d(register: Callable[..., Any], target: DescribedCloud, source: DescribedCloud) -> Match:
    """What a method of open3d, given its module, two clouds and their features, finds with the seed 0."""
    o3d.utility.random.seed(0)
    clouds = source.geometry, target.geometry, _features(source), _features(target)
    found = register(o3d.pipelines.registration, *clouds)
    return _rigid(np.asarray(found.transformation, float), len(found.correspondence_set), len(source))


def _features(cloud: DescribedCloud) -> Any:
    out = o3d.pipelines.registration.Feature()
    out.data = np.ascontiguousarray(cloud.features.T, dtype=np.float64)
    return out


def _rigid(motion: Floats, inliers: int, matches: int) -> Match:
    """The match, its rotation made orthonormal; the identity without an inlier where it is no rigid motion."""
    if not inliers or not se3.is_motion(motion):
        return Match(np.eye(4), 0, matches)
    return Match(se3.from_parts(se3.project_to_so3(motion[:3, :3]), motion[:3, 3]), inliers, matches)
