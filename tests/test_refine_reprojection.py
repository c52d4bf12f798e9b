"""Reprojection errors that decide: the same observations before and after, those behind a camera counted apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hodge_pipeline.refine.reprojection import reprojection_measures

import hodge_pipeline
from hodge_adapters.colmap_refining import ColmapModels
from hodge_adapters.colmap_reprojection import error_cap
from hodge_adapters.colmap_uncertainty import standard_errors
from hodge_pipeline import se3
from hodge_pipeline.types import ModelQuality
from test_refine_colmap import FREE, noisy

BEYOND_ANY_IMAGE_PX = 1e9


def quality(errors_px: dict[tuple[str, int], float]) -> ModelQuality:
    """A model with these errors at keypoints of images by name."""
    names = tuple(sorted({name for name, _ in errors_px}))
    keypoints = np.array([(names.index(name), column) for name, column in errors_px])
    values = np.array(list(errors_px.values()))
    return ModelQuality(len(names), 1, 1.0, names, keypoints, values, error_cap(values))


def turned_round(model: Path, out: Path) -> Path:
    """The model with its first body turned by half a circle about its own vertical: it sees nothing any more."""
    moved = pycolmap.Reconstruction(model)
    frame = moved.frames[min(moved.reg_frame_ids())]
    half = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    matrix = half @ np.vstack([frame.rig_from_world.matrix(), [0.0, 0.0, 0.0, 1.0]])
    frame.rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3]))
    out.mkdir()
    moved.write_binary(out)
    return out


def test_an_observation_behind_a_camera_is_counted_and_no_mean_is_taken_over_it() -> None:
    before = quality({("a", 0): 1.0, ("a", 1): 2.0, ("b", 0): np.inf, ("b", 1): 3.0})
    after = quality({("b", 0): 0.1, ("b", 1): 1.0, ("a", 0): 1.0, ("a", 1): 1.0})
    behind, mean = reprojection_measures([before], after, 0.005)
    assert (behind.before, behind.after, behind.is_worse) == (1, 0, False)
    assert (mean.before, mean.after, mean.is_worse) == (pytest.approx(2.0), pytest.approx(1.0), False)


def test_more_observations_behind_a_camera_are_worse_whatever_the_rest_says() -> None:
    before = quality({("a", column): 1.0 for column in range(1000)})
    after = quality({("a", column): 0.5 if column > 1 else np.inf for column in range(1000)})
    behind, mean = reprojection_measures([before], after, 0.005)
    assert behind.is_worse and not mean.is_worse


def test_one_observation_near_the_plane_of_its_camera_does_not_decide() -> None:
    before = quality({("a", column): 1.0 for column in range(1000)})
    after = quality({("a", column): 0.9 if column else 1e34 for column in range(1000)})
    _, mean = reprojection_measures([before], after, 0.005)
    assert mean.after == pytest.approx(0.9031) and not mean.is_worse


def test_only_observations_of_both_count_and_each_once() -> None:
    parts = [quality({("a", 0): 1.0, ("gone", 0): 50.0}), quality({("a", 0): 2.0, ("b", 0): 3.0})]
    _, mean = reprojection_measures(parts, quality({("b", 0): 1.0, ("a", 0): 1.0, ("new", 7): 60.0}), 0.005)
    assert (mean.before, mean.after) == (pytest.approx(2.0), pytest.approx(1.0))


def test_a_large_disturbance_does_not_hide_behind_the_cap() -> None:
    before = quality({("a", column): 60.0 + column for column in range(11)})
    after = quality({("a", column): 70.0 + column for column in range(11)})
    _, mean = reprojection_measures([before], after, 0.005)
    assert (mean.before, mean.after, mean.is_worse) == (pytest.approx(65.0), pytest.approx(75.0), True)


def test_errors_are_those_of_pycolmap(tmp_path: Path) -> None:
    (model,) = ColmapModels(database="none", images="none").open_models(noisy(tmp_path))
    theirs = pycolmap.Reconstruction(tmp_path / "model")
    theirs.update_point_3d_errors()
    lengths = np.array([theirs.points3D[key].track.length() for key in model.records.points.ids.tolist()])
    means = np.add.reduceat(model.quality.errors_px, np.r_[0, np.cumsum(lengths)[:-1]]) / lengths
    np.testing.assert_allclose(means, [theirs.points3D[key].error for key in model.records.points.ids.tolist()])


def test_one_point_near_the_plane_of_a_camera_does_not_make_every_pose_uncertain(tmp_path: Path) -> None:
    right = pycolmap.Reconstruction(noisy(tmp_path))
    wrong = pycolmap.Reconstruction(right)
    point = wrong.points3D[min(wrong.points3D)]
    cam_from_world = wrong.images[point.track.elements[0].image_id].cam_from_world()
    in_cam = cam_from_world * point.xyz
    point.xyz = cam_from_world.inverse() * np.array([in_cam[0], in_cam[1], 1e-2])
    sure, unsure = (
        np.sqrt((standard_errors(model.records, model.bodies) ** 2).mean(axis=0))
        for model in (ColmapModels(database="none", images="none").open_models([one])[0] for one in (right, wrong))
    )
    np.testing.assert_allclose(unsure, sure, rtol=0.05)


def test_no_number_of_a_refinement_is_that_of_a_point_behind_a_camera(tmp_path: Path) -> None:
    start = turned_round(noisy(tmp_path), tmp_path / "start")
    raw = pycolmap.Reconstruction(start)
    raw.update_point_3d_errors()
    assert raw.compute_mean_reprojection_error() > 1e100, "pycolmap's own mean is that of its sentinel"
    done = hodge_pipeline.refine_colmap(start, database="none", out=tmp_path / "out", overrides=FREE)
    (result,) = done.results
    behind, mean = result.decision.measures[:2]
    assert behind.before == np.isinf(result.start.quality.errors_px).sum() > 100
    assert max(mean.before, mean.after) < BEYOND_ANY_IMAGE_PX
    rows = json.loads((tmp_path / "out/report.json").read_text())["refinement"]["measures"]
    assert [row["name"] for row in rows[:2]] == [behind.name, mean.name]
    assert all(abs(row[when]) < BEYOND_ANY_IMAGE_PX for row in rows for when in ("before", "after"))
    moved = result.start.moved(result.start.world_from_body).reconstruction
    assert all(point.error < BEYOND_ANY_IMAGE_PX for point in moved.points3D.values())
    assert "e+1" not in result.decision.reason
