"""open3d, kept to one thread in a worker process.

open3d's registration sums over TBB threads in any order, so the last bits of a result would differ from run to run.
TBB takes the number of processors that the process may use when it is loaded, and has no other switch: so open3d is
imported while this process is bound to one processor. Where open3d was loaded before (in the process that owns a
run), nothing changes: there the last bits of `point_to_plane`, `coloured_icp` and `ndt` may differ.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


@contextmanager
def _one_processor() -> Iterator[None]:
    if not hasattr(os, "sched_setaffinity"):  # neither macOS nor Windows has it
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


with _one_processor():
    from hodge_pipeline.lean_open3d import o3d

    _cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.random.default_rng(0).uniform(size=(100, 3))))
    _cloud.estimate_normals()
    _method = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    o3d.pipelines.registration.registration_icp(_cloud, _cloud, 0.1, np.eye(4), _method)

__all__ = ["o3d"]
