"""Two sparse scans of a street, aligned both ways: beside test_registration, whose workers must not import open3d."""

from typing import cast

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.demo.street import Road
from hodge_pipeline.demo.sweeps import SpinningScanner
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.gicp import Gicp, Vgicp
from hodge_pipeline.types import Frame, PointCloud
from lidar_worlds import Stop


def test_sparse_scans_aligned_both_ways_stay_where_they_fit() -> None:
    """Six metres apart on a street: the coarse level of a way back would lead 1.4 m away."""
    scale = 15.0
    options = CloudOptions(voxel_m=0.04 * scale, min_range_m=0.0, max_range_m=200.0)
    distances_m = (0.3 * scale, 0.1 * scale, 0.05 * scale)
    registrar = Gicp(both_ways=True, distances_m=distances_m, source_points=(4000, 4000, 40000))
    stops, prepared = [Stop(3.0), Stop(3.0 + 6 / 7)], []
    for row, stop in enumerate(stops):
        seen = PointCloud(SpinningScanner(cast(Road, stop), 5, 16, 360, 1.0).sweep(row).points)
        frame = Frame(row, float(row), read_points=lambda seen=seen: seen)
        prepared.append(registrar.prepare(make_cloud(frame, options)[0]))
    first, second = (stop.world_from_car(np.zeros(1))[0] for stop in stops)
    truth = se3.inverse(first) @ second
    error = se3.inverse(truth) @ registrar.register(prepared[0], prepared[1], truth).i_from_j
    assert np.linalg.norm(error[:3, 3]) < 0.1


def test_other_numbers_of_levels_have_the_points_of_the_finest() -> None:
    """As `distances_m` alone is set, in a recipe or by `register`."""
    assert Gicp(distances_m=(1.0, 0.3, 0.1, 0.05))._levels == [(1.0, 1000), (0.3, 1000), (0.1, 2000), (0.05, 4000)]
    assert Vgicp(distances_m=(1.0, 0.3))._levels == [(1.0, 2000), (0.3, 4000)]
