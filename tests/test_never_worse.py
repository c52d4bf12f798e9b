"""A real model disturbed and refined is never worse than its input or plain bundle adjustment (more: benchmarks)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, thinned
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.ties import similarity
from hodge_pipeline import se3
from hodge_pipeline.refine.model_solve import calibrated
from hodge_pipeline.types import Floats, ViewGraph

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from colmap import MOST_WORSE_PERCENT, PEER, compared, cpu_of, disturbed, same_bytes

CASES = [("maupertuis_good", kind) for kind in ("given", "big", "noise", "wrong", "halves", "renamed")]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_never_worse_than_the_input_or_plain_bundle_adjustment(
    data_dir: Path, tmp_path: Path, name: str, kind: str
) -> None:
    good, out = data_dir / "colmap/disturbed" / name, tmp_path / "out"
    starts = disturbed(good, tmp_path / "start", kind, 0)
    worst = []
    for number, start in enumerate(starts):
        peer = tmp_path / f"peer{number}"
        peer.mkdir()
        cpu_of([sys.executable, "-c", PEER, str(start), str(peer)])
        worst.append(min(compared(good, one, kind)[0] for one in (start, peer)))
    done = hodge_pipeline.refine_colmap(tmp_path / "start", database="none", images="none", out=out, overrides=FREE)
    assert done.exit_code == 0 and len(done.models) == 1, "halves are joined"
    assert compared(good, out / "sparse/0", kind)[0] <= max(worst) + MOST_WORSE_PERCENT
    if kind == "given":
        assert same_bytes(starts[0], [out / "sparse/0"])


def test_the_models_that_came_out_worse_before(data_dir: Path, tmp_path: Path) -> None:
    for name, good in (("mouse_noise", "mouse_good"), ("maupertuis_wrong", "maupertuis_good")):
        folder = data_dir / "colmap/disturbed"
        done = hodge_pipeline.refine_colmap(folder / name, out=tmp_path / name, overrides=FREE)
        assert done.results[0].decision.outcome == "refined"
        assert compared(folder / good, tmp_path / name / "sparse/0", "noise")[0] < 0.001


def test_a_join_is_as_exact_as_the_images_that_both_models_have(data_dir: Path) -> None:
    first = pycolmap.Reconstruction(data_dir / "colmap/disturbed/mouse_good")
    second = pycolmap.Reconstruction(first)
    ids = sorted(first.points3D)[:600]
    rng = np.random.default_rng(0)
    size = np.ptp([point.xyz for point in first.points3D.values()], axis=0).max()
    for key in ids[:280]:  # ties by matches: the same points, triangulated apart
        second.points3D[key].xyz = second.points3D[key].xyz + rng.normal(scale=0.003 * size, size=3)
    second.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0.3, 0.5, -0.2])), np.array([1.0, 2.0, 3.0])))
    found = similarity(first, second, np.array([ids, ids]).T)
    assert found is not None and found[0].scale == pytest.approx(0.5, rel=1e-9)


def test_poses_come_back_where_the_points_are_wrong_as_well(data_dir: Path, tmp_path: Path) -> None:
    """A quarter of its points: of all, poses come back to 0.01 % (benchmarks/colmap.py)."""
    good = thinned(data_dir / "colmap/disturbed/mouse_good", tmp_path / "good", 4)
    out = tmp_path / "out"
    (start,) = disturbed(good, tmp_path / "start", "carried", 0)
    (tmp_path / "peer").mkdir()
    cpu_of([sys.executable, "-c", PEER, str(start), str(tmp_path / "peer")])
    done = hodge_pipeline.refine_colmap(start, database="none", images="none", out=out, overrides=FREE)
    assert compared(good, tmp_path / "peer", "carried")[0] > 1.0 > 3 * compared(good, out / "sparse/0", "carried")[0]
    assert len(done.results[0].candidates) > 2


@pytest.fixture(scope="module")
def measured(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Floats, ViewGraph]:
    """Right poses of a model, and the edges of the same one with every pose wrong."""
    good = data_dir / "colmap/disturbed/mouse_good"
    (start,) = disturbed(good, tmp_path_factory.mktemp("measured") / "start", "big", 0)
    (right,), (model,) = (ColmapModels(database="none", images="none").open_models(one) for one in (good, start))
    graph, _ = model.measured()
    return right.world_from_body, graph


def test_edges_of_shared_points_are_right(measured: tuple[Floats, ViewGraph]) -> None:
    poses, graph = measured
    i, j = graph.edges.T
    turn = se3.so3_log((se3.inverse(graph.i_from_j) @ se3.inverse(poses[i]) @ poses[j])[:, :3, :3])
    angle_deg = np.degrees(np.linalg.norm(turn, axis=1))
    assert len(angle_deg) > 500 and angle_deg.max() < 10 and np.median(angle_deg) < 0.3


def test_the_noise_of_edges_is_that_of_their_cycles_whatever_the_poses(measured: tuple[Floats, ViewGraph]) -> None:
    poses, graph = measured
    disturbed_poses = poses @ se3.exp(np.random.default_rng(0).normal(scale=0.1, size=(56, 6)))
    right, wrong = (calibrated(graph, each).information for each in (poses, disturbed_poses))
    np.testing.assert_array_equal(right, wrong)
