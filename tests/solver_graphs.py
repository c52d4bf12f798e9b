"""Small graphs that the solver tests share, and the certified optima of the real ones."""

import dataclasses

import numpy as np
from scipy.sparse import csc_matrix

from hodge_adapters.pose_graphs.g2o import information_for_file, load_g2o
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, ViewGraph

CERTIFIED_OPTIMA = {
    "smallGrid3D": 1025.39806,
    "parking-garage": 1.26252443,
    "sphere2500": 1687.005814,
    "torus3D": 24227.04556,
    "cubicle": 717.125991,
    "MIT": 61.1541155,
    "CSAIL": 31.7037159,
    "intel": 52.3482273,
    "manhattan": 6431.391387,
    "kitti_00": 125.693515,
    "kitti_05": 276.514377,
}


PLANAR_OUTSIDE = [0, 1, 5]


def ladder(noise: float, seed: int = 0, rungs: int = 6, planar: bool = False) -> tuple[ViewGraph, np.ndarray]:
    """0—2—4—…
    |  |  |     two rails, a rung at each step, and its true poses.
    1—3—5—…
    """
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(2 * rungs, 6))
    rail = [(i, i + 2) for i in range(2 * rungs - 2)]
    edges = np.array(rail + [(2 * i, 2 * i + 1) for i in range(rungs)])
    errors = noise * rng.normal(size=(len(edges), 6))
    information = np.tile(np.diag([4.0, 4, 4, 1, 1, 1]), (len(edges), 1, 1))
    if planar:
        for array in (twists, errors):
            array[:, PLANAR_OUTSIDE] = 0
        information[:, PLANAR_OUTSIDE] = 0
    truth = se3.exp(twists)
    truth = se3.inverse(truth[:1]) @ truth
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(errors)
    return ViewGraph.from_edges(np.arange(2 * rungs), edges, measured, information), truth


def as_sesync_reads_it(data_dir, name):
    file = load_g2o(data_dir / "pose_graphs" / "sesync" / f"{name}.g2o")
    if file.graph.dimension == 2:
        return file.graph
    return dataclasses.replace(
        file.graph, information=np.roll(information_for_file(file.graph.information), (3, 3), axis=(1, 2))
    )


def laplacian(tail: Ints, head: Ints, weights: Floats, free_count: int) -> csc_matrix:
    """The weighted graph Laplacian of the first `free_count` vertices, the others pinned."""
    rows = np.concatenate([tail, head, tail, head])
    columns = np.concatenate([tail, head, head, tail])
    values = np.concatenate([weights, weights, -weights, -weights])
    kept = (rows < free_count) & (columns < free_count)
    return csc_matrix((values[kept], (rows[kept], columns[kept])), shape=(free_count, free_count))
