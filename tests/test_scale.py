"""Scans of any size: one factor on the lengths of a recipe that is written for rooms."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.clouds.ply import write_ply
from hodge_pipeline import se3
from hodge_pipeline.recipe.scale import measured_scale, scale_of_scans, scaled_recipe
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.in_units import InUnits
from hodge_pipeline.review.opening import Review
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Floats, Frame, PointCloud, Source
from hodge_pipeline.types.notes import Note
from test_global_registration import furnished_corner

VOXEL_M = 0.04
POSES = se3.exp(np.array([[0.1, 0.2, 0.1, 1.0, 1.0, 1.0], [0.5, -0.7, 1.9, 1.2, 0.8, 1.1]]))


def read(points: Floats) -> PointCloud:
    return PointCloud(points.astype(np.float32))


def scans(*clouds: Floats) -> list[Frame]:
    return [Frame(row, float(row), read_points=partial(read, points)) for row, points in enumerate(clouds)]


@pytest.mark.parametrize("size", [1e-3, 0.05, 30.0, 1000.0])
def test_the_factor_follows_the_size_of_the_scans(size: float) -> None:
    corner = furnished_corner(0, 20_000)
    assert measured_scale(scans(corner, corner), VOXEL_M) == 1.0
    found = measured_scale(scans(*[size * corner] * 3), VOXEL_M)
    assert size / 2 < found < 2 * size
    assert measured_scale(scans(*[size * corner] * 3), VOXEL_M * found) == 1.0


@pytest.mark.parametrize(("size", "kinds"), [(1.0, []), (30.0, ["scale"]), (1000.0, ["scan unit"])])
def test_that_scans_are_large_is_a_fact_and_that_they_may_not_be_in_metres_needs_a_look(
    size: float, kinds: list[str]
) -> None:
    notes = list[Note]()
    source = Source("scans", Path("scans"), tuple(scans(*[size * furnished_corner(0, 20_000)] * 2)))
    scale_of_scans(source, VOXEL_M, step=cast(Step, SimpleNamespace(note=notes.append)))
    assert [note.kind for note in notes] == kinds
    assert all(("centimetres: 100" in note.detail) == (note.kind == "scan unit") for note in notes)


def test_scans_that_show_no_size_do_not_count() -> None:
    corner = furnished_corner(0, 20_000)
    five, one_place = np.eye(5, 3), np.zeros((9000, 3))
    assert measured_scale(scans(five, one_place), VOXEL_M) == 1.0
    assert measured_scale(scans(five, 30 * corner, np.full((9000, 3), np.nan), 30 * corner), VOXEL_M) > 10
    assert measured_scale([Frame(0, 0.0)], VOXEL_M) == 1.0


def test_voxels_with_a_point_each_say_nothing_of_the_surfaces() -> None:
    sparse = 30 * furnished_corner(0, 8000)
    assert measured_scale(scans(sparse, sparse), VOXEL_M) > 10
    thinned = furnished_corner(0, 30_000)
    thinned = thinned[np.unique(np.floor(thinned / 0.05), axis=0, return_index=True)[1]]
    assert measured_scale(scans(thinned, thinned), VOXEL_M) == 1.0


def test_every_length_is_taken_times_the_factor_and_nothing_else() -> None:
    before = load_recipe("scans")
    after = scaled_recipe(before, 10.0)
    assert after.clouds.voxel_m == pytest.approx(0.4) and after.clouds.stride == before.clouds.stride
    assert after.start.registrar.voxel_m == pytest.approx(0.5)  # type: ignore[attr-defined]
    assert after.start.refine == InUnits(before.start.refine, 10.0)  # type: ignore[attr-defined]
    assert after.start.limits.max_rmse_m == pytest.approx(0.6)  # type: ignore[attr-defined]
    assert after.edges.builders[1].voxel_m == pytest.approx(1.0)  # type: ignore[attr-defined]
    assert after.fusion[0].voxel_m == pytest.approx(0.1)  # type: ignore[attr-defined]
    assert scaled_recipe(before, 1.0) is before
    assert scaled_recipe(after, 0.1).acceptance.max_rmse_m == pytest.approx(before.acceptance.max_rmse_m)


@pytest.mark.parametrize("size", [0.05, 40.0])
def test_a_scene_of_another_size_gives_the_same_poses_in_its_size(tmp_path: Path, size: float) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for row, pose in enumerate(POSES):
        points = se3.transform(se3.inverse(pose), furnished_corner(row, 8000))
        write_ply(folder / f"{row}.ply", read(size * points))
    plain = ["recording.level=off", "executor={stage: local, workers: 0}", "outer_iterations=1"]
    run = hodge_pipeline.run(load_recipe("scans", plain, folder), tmp_path / "run")
    found = se3.inverse(run.result.world_from_cam[0]) @ run.result.world_from_cam[1]
    found[:3, 3] /= size
    assert np.abs(se3.log(se3.inverse(se3.inverse(POSES[0]) @ POSES[1]) @ found)).max() < 0.01
    assert any("all lengths of the recipe are taken times" in str(note) for note in run.report.notes)
    assert run.report.scores is not None and run.report.scores.scale == pytest.approx(size, rel=1.0)
    with Review(tmp_path / "run", scene=False) as review:
        review.session.wait()
        review.session.pick([0, 1])
        review.session.place(run.result.world_from_cam[1] @ se3.exp(np.array([0, 0, 0.02, 0.03 * size, 0, 0])))
        review.session.register()
        review.session.wait()
        candidate = review.session.candidate
    assert candidate is not None and candidate.found is not None and candidate.rejected == ""
    assert candidate.residual_m < 0.005 * size
