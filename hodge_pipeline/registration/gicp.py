"""Generalised ICP (Segal et al., RSS 2009) and its voxelised form (Koide et al., ICRA 2021), by small_gicp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import small_gicp
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MIN_POINTS, Assessment, assess, to_registration, unregistered
from hodge_pipeline.types import Floats, Ints, PointCloud, Registration

ROTATION_EPSILON_RAD = 1e-3
"""Least step of rotation: 5 mm at 5 m, below the spacing of points."""
EPSILON_SHARE = 0.02
"""Least step of translation, of the finest distance: 1 mm of the usual 5 cm."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class _SmallGicp:
    """Options of both forms, and the registration level by level."""

    distances_m: tuple[float, ...] = Field(
        default=(0.3, 0.1, 0.05),
        min_length=1,
        description="Metres, coarse to fine: how far apart corresponding points may be. 0.3 forgives a start 10 cm and "
        "5° off.",
    )
    source_points: tuple[int, ...] = Field(
        default=(1000, 2000, 4000),
        min_length=1,
        description="Points of cloud j used at each level, evenly strided, the last at the finest level; those before "
        "the first have as many. 4000 lose no accuracy against all 7500 of a room's cloud.",
    )
    max_iterations: int = Field(
        default=20,
        ge=1,
        description="Steps at each level; a level stops earlier once a step is below 1 mrad and 1/50 of the finest "
        "distance.",
    )
    neighbours: int = Field(
        default=10, ge=5, description="Points in the covariance of a point. 10: enough for a plane."
    )
    points_per_sample: float = Field(
        default=100.0,
        gt=0,
        description="Source points (one a voxel) that count as one independent measurement in the information, since "
        "neighbours share their error. Calibrated on real pairs so that their errors have the size that the "
        "information says.",
    )
    seed: int = Field(
        default=0,
        ge=0,
        description="Of the sample of source points: which point it begins with. The recipe's seed, where none is "
        "given.",
    )

    @model_validator(mode="after")
    def _check_levels(self) -> _SmallGicp:
        if min(self.distances_m) <= 0 or min(self.source_points) < MIN_POINTS:
            raise ValueError(f"distances_m must be positive, source_points at least {MIN_POINTS}")
        return self

    @property
    def _levels(self) -> list[tuple[float, int]]:
        """Distance and number of points, coarse to fine."""
        levels = len(self.distances_m)
        counts = (*self.source_points[:1] * levels, *self.source_points)
        return list(zip(self.distances_m, counts[-levels:], strict=True))

    def _registered(
        self, align: Callable[..., Any], target: PreparedCloud, source: PreparedCloud, i_from_j: Floats
    ) -> Registration:
        """The registration, level by level; `align` calls small_gicp on a sample of the source."""
        guess = np.asarray(i_from_j, np.float64)
        if min(len(target), len(source)) < MIN_POINTS:
            return unregistered(guess)
        motion, iterations, converged = guess, 0, False
        for distance_m, count in self._levels:
            result = align(
                source.sample(count),
                motion,
                max_correspondence_distance=distance_m,
                max_iterations=self.max_iterations,
                rotation_epsilon=ROTATION_EPSILON_RAD,
                translation_epsilon=EPSILON_SHARE * self.distances_m[-1],
            )
            if not se3.is_motion(result.T_target_source):  # a singular system: nothing within the distance
                return unregistered(guess)
            motion, converged = np.asarray(result.T_target_source), bool(result.converged)
            iterations += 1 + int(result.iterations)  # small_gicp counts from 0
        sample = source.sample_rows(self.source_points[-1])
        per_sample = self.points_per_sample * len(sample) / len(source)
        assessment = target.assess(source, sample, motion, self.distances_m[-1], per_sample)
        return to_registration(assessment, motion, iterations, converged)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Gicp(_SmallGicp):
    """Plane-to-plane ICP. It needs a guess within about 10 cm and 5°."""

    both_ways: bool = Field(
        default=False,
        description="Align j with i, then, below the coarsest level, i with j, and take the middle, and the mean of "
        "information and fitness: each way errs by the sampling of its target.",
    )

    def prepare(self, cloud: PointCloud) -> PreparedCloud:
        """Trees and covariances of a cloud, each made when it is first needed."""
        return PreparedCloud(cloud, self.neighbours, seed=self.seed)

    def register(self, target: PreparedCloud, source: PreparedCloud, i_from_j: Floats) -> Registration:
        """Cloud j (source) moved onto cloud i (target) from the guess."""
        found = self._one_way(target, source, i_from_j)
        if not self.both_ways or not found.converged:
            return found
        # The coarsest level would lead away again: of scans of few beams by metres.
        finer = replace(self, distances_m=self.distances_m[1:] or self.distances_m)
        back = finer._one_way(source, target, se3.inverse(found.i_from_j))
        if not back.converged:
            return found
        apart = se3.log(se3.inverse(found.i_from_j) @ se3.inverse(back.i_from_j))
        middle = found.i_from_j @ se3.exp(apart / 2)
        information = (found.information + se3.pull_back(middle, back.information)) / 2
        fitness = (found.fitness + back.fitness) / 2
        return replace(found, i_from_j=middle, information=information, fitness=fitness)

    def _one_way(self, target: PreparedCloud, source: PreparedCloud, i_from_j: Floats) -> Registration:
        def align(sample: Any, guess: Floats, **criteria: float) -> Any:
            return small_gicp.align(target.cloud, sample, target.tree, guess, **criteria)

        return self._registered(align, target, source, i_from_j)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Vgicp(_SmallGicp):
    """Plane-to-plane ICP against voxel Gaussians of the target: wider steps, slightly less accurate."""

    voxel_m: float = Field(default=0.1, gt=0, description="Metres; side of the target's Gaussian voxels.")

    def prepare(self, cloud: PointCloud) -> PreparedCloud:
        """Trees, covariances and voxels of a cloud, each made when it is first needed."""
        return PreparedCloud(cloud, self.neighbours, self.voxel_m, seed=self.seed)

    def register(self, target: PreparedCloud, source: PreparedCloud, i_from_j: Floats) -> Registration:
        """Cloud j (source) moved onto cloud i (target) from the guess."""
        if len(target) and target.voxels.size() < MIN_POINTS:
            return unregistered(np.asarray(i_from_j, np.float64))

        def align(sample: Any, guess: Floats, **criteria: float) -> Any:
            return small_gicp.align(target.voxels, sample, guess, **criteria)

        return self._registered(align, target, source, i_from_j)


class PreparedCloud:
    """A cloud with what small_gicp needs. A target costs a tree and all covariances, a source only a sample's."""

    def __init__(self, cloud: PointCloud, neighbours: int, voxel_m: float = 0.1, seed: int = 0) -> None:
        finite = np.isfinite(cloud.points_in_cam).all(axis=1)
        self.points = np.asarray(cloud.points_in_cam[finite], np.float64)
        self._given_normals = None if cloud.normals_in_cam is None else np.asarray(cloud.normals_in_cam[finite], float)
        self.neighbours, self.voxel_m, self.seed = neighbours, voxel_m, seed
        self._samples: dict[int, Any] = {}

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def cloud(self) -> Any:
        """All points with covariances."""
        return self._with_covariances(self.points, self.tree)

    @cached_property
    def tree(self) -> Any:
        """The search tree of all points."""
        return small_gicp.KdTree(small_gicp.PointCloud(self.points))

    @cached_property
    def voxels(self) -> Any:
        """The Gaussian voxels of all points."""
        voxels = small_gicp.GaussianVoxelMap(self.voxel_m)
        voxels.insert(self.cloud)
        return voxels

    @cached_property
    def normals(self) -> Floats:
        """Unit normals (N, 3): the cloud's own, else estimated."""
        if self._given_normals is not None:
            return self._given_normals
        cloud = small_gicp.PointCloud(self.points)
        small_gicp.estimate_normals(cloud, self.tree, min(self.neighbours, len(self)))
        return np.asarray(cloud.normals())[:, :3]

    def sample(self, count: int) -> Any:
        """About `count` points, evenly strided, with covariances of their own neighbours in the sample."""
        stride = self._stride(count)
        if stride == 1:
            return self.cloud
        if stride not in self._samples:
            self._samples[stride] = self._with_covariances(self.sample_points(count), None)
        return self._samples[stride]

    def sample_points(self, count: int) -> Floats:
        """The points (n, 3) of that sample."""
        return self.points[self.sample_rows(count)]

    def sample_rows(self, count: int) -> Ints:
        """The rows (n,) of that sample."""
        stride = self._stride(count)
        return np.arange(self.seed % stride, len(self), stride)

    def find_nearest(self, queries: Floats) -> tuple[Ints, Floats]:
        """Rows of the nearest points and the squared distances."""
        rows, squared = self.tree.batch_knn_search(queries, 1)
        return np.asarray(rows).reshape(-1).astype(np.int64), np.asarray(squared).reshape(-1)

    def assess(
        self, source: PreparedCloud, rows: Ints, i_from_j: Floats, max_distance_m: float, points_per_sample: float
    ) -> Assessment:
        """What a registration of these points (n,) of the source to this cloud is worth, see `assessment.assess`."""
        return assess(
            self.find_nearest, self.points, self.normals, source.points[rows], source.normals[rows], i_from_j,
            max_distance_m=max_distance_m, points_per_sample=points_per_sample,
        )  # fmt: skip

    def _stride(self, count: int) -> int:
        return max(1, -(-len(self) // count))

    def _with_covariances(self, points: Floats, tree: Any) -> Any:
        cloud = small_gicp.PointCloud(points)
        small_gicp.estimate_covariances(cloud, tree, min(self.neighbours, len(points)))
        return cloud
