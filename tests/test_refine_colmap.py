"""`refine_colmap`: poses come back, what is optimal stays, and nothing becomes worse."""

from __future__ import annotations

import json
import re
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

import hodge_pipeline
from colmap_data import FREE, disturbed, error_px, noisy, thinned, tracks
from hodge_adapters.colmap import bundle, tracked
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.tracked import ColmapModel
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine import candidates, choice
from hodge_pipeline.refine.candidates import ADJUSTED, GIVEN, POINTS, RESECTED, adjusted_model
from hodge_pipeline.stages import Step


@pytest.mark.parametrize("database", [False, True])
def test_disturbed_poses_come_back_with_every_rig_name_and_track(tmp_path: Path, database: bool) -> None:
    model = noisy(tmp_path, database=database)
    start = disturbed(model, tmp_path / "start")
    given = "auto" if database else "none"
    done = hodge_pipeline.refine_colmap(start, database=given, out=tmp_path / "out", overrides=FREE)
    assert done.exit_code == 0 and done.results[0].decision.outcome == "refined"
    assert [name for name, _ in done.results[0].candidates] == [GIVEN, RESECTED], (
        "no other is as cheap or can be better"
    )
    before, after = pycolmap.Reconstruction(model), pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert error_px(start) > 3 and error_px(tmp_path / "out/sparse/0") <= 1.001 * error_px(model)
    assert tracks(after) == tracks(before)
    assert {i: image.name for i, image in after.images.items()} == {i: m.name for i, m in before.images.items()}
    assert after.num_rigs() == before.num_rigs() and after.num_frames() == before.num_frames()
    for key, rig in before.rigs.items():
        for sensor, pose in rig.non_ref_sensors.items():
            np.testing.assert_allclose(after.rigs[key].non_ref_sensors[sensor].matrix(), pose.matrix(), atol=1e-12)
    for key, camera in before.cameras.items():
        np.testing.assert_array_equal(after.cameras[key].params, camera.params)
    assert (tmp_path / "out/sparse/0/images.txt").is_file(), "text stays text"


def test_one_image_of_many_that_is_off_is_no_optimum(tmp_path: Path) -> None:
    """It weighs little in the mean of all errors, which keypoints of a pixel's noise make large.

    And the others stay where they were, in UTM coordinates too: the world is not drawn along, nor scaled.
    """
    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D = 40, 150
    options.camera_params = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1280.0, 1024, 768).params
    pycolmap.set_random_seed(0)
    model, rng = pycolmap.synthesize_dataset(options), np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(scale=1.0, size=2)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([5e5, 4e6, 200.0])))
    frame = model.frames[min(model.reg_frame_ids())]
    off = se3.exp([0.05, 0, 0, 0.5, 0, 0]) @ np.vstack([frame.rig_from_world.matrix(), [0, 0, 0, 1]])
    frame.rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(off[:3]))
    (result,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert result.decision.outcome == "refined"
    moved = (result.model.world_from_body - result.start.world_from_body)[:, :3, 3]
    assert np.sort(np.linalg.norm(moved, axis=1))[-2] < 0.03 < 10, "cameras lie on a sphere of radius 10"
    assert len(result.candidates[0][1].images_off) == 1 and not result.candidates[result.kept_row][1].images_off


def swapped(model: pycolmap.Reconstruction, share: float) -> pycolmap.Reconstruction:
    """The model with a share of each image's observations given to another point."""
    rng = np.random.default_rng(0)
    for image_id, image in model.images.items():
        seen = [column for column in range(image.num_points2D()) if image.points2D[column].has_point3D()]
        columns = rng.permutation(seen)[: 2 * int(share * len(seen) / 2)].tolist()
        for one, other in zip(columns[::2], columns[1::2], strict=True):
            owners = image.points2D[one].point3D_id, image.points2D[other].point3D_id
            model.delete_observation(image_id, one)
            model.delete_observation(image_id, other)
            model.add_observation(owners[1], pycolmap.TrackElement(image_id, one))
            model.add_observation(owners[0], pycolmap.TrackElement(image_id, other))
    return model


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_wrong_tracks_do_not_bend_the_model(tmp_path: Path, share: float) -> None:
    """A tenth of the observations pulls no pose; where nothing but wrong ones is left the input comes back, exit 3."""
    model = noisy(tmp_path)
    true = pycolmap.Reconstruction(model)
    start = swapped(pycolmap.Reconstruction(disturbed(model, tmp_path / "start")), share)
    done = hodge_pipeline.refine_colmap(start, database="none", overrides=FREE)
    decision, ids = done.results[0].decision, true.reg_image_ids()
    if share > 0.5:
        assert (decision.outcome, done.exit_code) == ("worse", 3) and "tracks contradict" in decision.doubt
        return
    assert decision.outcome == "refined" and not decision.doubt
    models = (true, start, done.models[0])
    poses = [se3.from_parts(np.eye(3), [m.images[i].projection_center() for i in ids]) for m in models]
    off = [absolute_error(one, poses[0], with_scale=True).rmse_m for one in poses[1:]]
    assert off[1] < 0.05 * off[0]


def test_points_that_are_wrong_beside_right_poses_are_mended_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However well tracks fix other poses: no points need them."""
    model, rng = pycolmap.Reconstruction(noisy(tmp_path)), np.random.default_rng(0)
    monkeypatch.setattr(candidates, "told_apart", lambda *_: True)
    before = {key: frame.rig_from_world.matrix() for key, frame in model.frames.items()}
    for point in model.points3D.values():
        point.xyz = point.xyz + rng.normal(scale=0.2, size=3)
    done = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE)
    (result,) = done.results
    assert result.decision.outcome == "refined" and not result.decision.doubt
    assert result.decision.reason.endswith("by bundle adjustment of points alone")
    for key, frame in done.models[0].frames.items():
        np.testing.assert_allclose(frame.rig_from_world.matrix(), before[key], atol=1e-9)
    done.models[0].update_point_3d_errors()
    assert done.models[0].compute_mean_reprojection_error() <= 1.001 * error_px(tmp_path / "model")


@pytest.mark.filterwarnings("error:Mean of empty slice")
def test_a_model_of_few_points_is_no_better_for_a_billionth_of_a_pixel() -> None:
    """As two images of one point are: neither is its change of a known size."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 2, 1
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + 1e-5
    (result,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert result.decision.outcome == "optimal" and "better than any keypoint" in result.decision.reason
    (forced,) = hodge_pipeline.refine_colmap(model, database="none", force=True, overrides=FREE).results
    assert "known to" not in str(forced.decision.change)


def test_a_point_on_a_camera_fixes_no_pose() -> None:
    """As a robust loss leaves one that two wrong observations share: it would outweigh all others."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 60
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    (whole,) = ColmapModels(database="none").open_models([model])
    key = min(model.points3D)
    element = model.points3D[key].track.elements[0]
    image = model.images[element.image_id]
    ray = se3.inverse(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))[:3, 2]
    model.points3D[key].xyz = image.projection_center() + 1e-12 * ray
    image.points2D[element.point2D_idx].xy = image.project_point(model.points3D[key].xyz)
    (touching,) = ColmapModels(database="none").open_models([model])
    errors = [one.information.standard_errors for one in (whole, touching)]
    assert np.isfinite(errors[1]).all() and (errors[1] > 0.5 * np.median(errors[0], axis=0)).all()


def test_a_large_model_is_adjusted_by_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP takes all cores from 50,000 numbers on, whose sums then have no order: no two results were the same."""
    create = Mock(side_effect=pycolmap.create_default_bundle_adjuster)
    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", create)
    ColmapModels().open_models(noisy(tmp_path))[0].adjusted()
    assert [call.args[0].ceres.solver_options.num_threads for call in create.call_args_list] == [1]


def test_an_optimal_model_is_given_back_byte_for_byte(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    done = hodge_pipeline.refine_colmap(model, out=tmp_path / "out", overrides=FREE)
    decision = done.results[0].decision
    assert decision.outcome == "optimal"
    assert [name for name, _ in done.results[0].candidates] == [GIVEN, ADJUSTED], "points alone can gain nothing"
    names = sorted(path.name for path in model.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "out/sparse/0").iterdir())
    for name in names:
        assert (tmp_path / "out/sparse/0" / name).read_bytes() == (model / name).read_bytes()


def test_an_adjustment_of_points_leaves_poses_and_rigs_bit_for_bit(tmp_path: Path) -> None:
    (model,) = ColmapModels().open_models(disturbed(noisy(tmp_path), tmp_path / "start"))
    adjusted = model.adjusted(move_bodies=False)
    before, after = model.reconstruction, adjusted.reconstruction
    assert not np.array_equal(adjusted.records.points.xyz, model.records.points.xyz)
    np.testing.assert_array_equal(adjusted.world_from_body, model.world_from_body)
    sensors = [(key, sensor) for key, rig in before.rigs.items() for sensor in rig.non_ref_sensors]
    assert sensors
    for key, sensor in sensors:
        places = (one.rigs[key].non_ref_sensors[sensor].matrix() for one in (before, after))
        np.testing.assert_array_equal(*places)


def test_observations_are_held_out_of_a_sample_of_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (model,) = ColmapModels().open_models(noisy(tmp_path))
    step = Step(tmp_path, Mock(), Mock())
    whole = choice.held_out_errors_px(model, model, False, 0, step=step)
    monkeypatch.setattr(choice, "ENOUGH_SEEN", 20)
    part = choice.held_out_errors_px(model, model, False, 0, step=step)
    most = 20 * model.quality.images * choice.OBSERVATIONS_HELD_OUT
    assert 0 < part.shape[1] < 1.5 * most < whole.shape[1]
    assert np.median(part[0]) == pytest.approx(np.median(whole[0]), rel=0.5)


def test_a_reconstruction_goes_in_and_comes_out_and_nothing_is_computed_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = noisy(tmp_path)
    start = pycolmap.Reconstruction(disturbed(model, tmp_path / "start"))
    counts = {name: Mock(wraps=getattr(tracked, name)) for name in ("content_of", "information")}
    for name, counted in counts.items():
        monkeypatch.setattr(tracked, name, counted)
    (refined,) = hodge_pipeline.refine_colmap(start, database="none", overrides=FREE).models
    assert {name: counted.call_count for name, counted in counts.items()} == {"content_of": 0, "information": 1}
    refined.update_point_3d_errors()
    assert refined.compute_mean_reprojection_error() <= 1.001 * error_px(model)


def test_an_adjustment_near_its_optimum_takes_few_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.synthetic_colmap import make

    (tmp_path / "street").mkdir()
    make("street", 12, 1).write(tmp_path / "street")
    steps: list[int] = []

    def solve(adjuster: pycolmap.BundleAdjuster) -> None:
        steps.append(int(re.findall(r"Iterations: (\d+)", adjuster.solve().brief_report())[0]))

    monkeypatch.setattr(bundle, "_solve", solve)
    for path, off in ((noisy(tmp_path), 0.05), (tmp_path / "street", 0.001)):
        (model,) = ColmapModels().open_models(path)
        xi = off * np.random.default_rng(0).normal(size=(len(model.body_names), 6))
        near = model.moved(model.world_from_body @ se3.exp(xi))
        found, other = near.adjusted(near_optimum=True), near.adjusted()
        np.testing.assert_allclose(found.quality.errors_px, other.quality.errors_px, atol=1e-4)
    assert steps[0] <= 8, "it goes on among rounding errors"
    assert 2 * steps[2] <= steps[3], "its first steps are short"


@pytest.mark.parametrize(("off", "near"), [(0.0, True), (0.05, False)])
def test_poses_that_make_a_model_sound_are_near_its_optimum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, off: float, near: bool
) -> None:
    told: list[bool] = []

    def adjusted(self: ColmapModel, priors: object, *, near_optimum: bool) -> ColmapModel:
        told.append(near_optimum)
        return self

    monkeypatch.setattr(ColmapModel, "adjusted", adjusted)
    (model,) = ColmapModels().open_models(noisy(tmp_path))
    xi = off * np.random.default_rng(0).normal(size=(len(model.body_names), 6))
    for whole_steps in (True, False):
        poses = model.world_from_body @ se3.exp(xi)
        adjusted_model(model, poses, None, whole_steps=whole_steps, step=Step(tmp_path, Mock(), Mock()))
    assert told == [near, False]


def test_poses_that_tracks_hardly_fix_are_set_beside_those_of_the_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = disturbed(noisy(tmp_path), tmp_path / "start")
    monkeypatch.setattr(candidates, "told_apart", lambda *_: False)
    (result,) = hodge_pipeline.refine_colmap(start, database="none", overrides=FREE).results
    assert [name for name, _ in result.candidates][:4] == [GIVEN, POINTS, ADJUSTED, RESECTED]


def test_an_adjustment_that_does_not_converge_is_set_beside_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = disturbed(noisy(tmp_path), tmp_path / "start")
    usual = bundle._options

    def few_steps(refine: bundle.Refine) -> pycolmap.BundleAdjustmentOptions:
        options = usual(refine)
        options.ceres.solver_options.max_num_iterations = 2
        return options

    monkeypatch.setattr(bundle, "_options", few_steps)
    (result,) = hodge_pipeline.refine_colmap(start, database="none", overrides=FREE).results
    assert result.candidates[-1][1].is_sound and ADJUSTED in [name for name, _ in result.candidates]


def spoil(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every bundle adjustment from now on leaves the bodies anywhere."""
    honest = ColmapModel.adjusted

    def adjusted(
        self: ColmapModel, priors: object = None, *, move_bodies: bool = True, near_optimum: bool = False
    ) -> ColmapModel:
        model = honest(self, None, move_bodies=move_bodies)
        rng = np.random.default_rng(0)
        for frame_id, pose in zip(model.bodies.frame_ids, model.world_from_body, strict=True):
            moved = se3.inverse(pose @ se3.exp(rng.normal(scale=0.3, size=6)))
            model.reconstruction.frames[frame_id].rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(moved[:3]))
        return model

    monkeypatch.setattr(ColmapModel, "adjusted", adjusted)


def test_a_candidate_that_is_worse_is_kept_out_unless_forced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = noisy(tmp_path)
    spoil(monkeypatch)
    out = tmp_path / "out"
    command = ["refine", "colmap", str(model), "--out", str(out), "--set", FREE[0], "--quiet"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert (out / "sparse/0/images.bin").read_bytes() == (model / "images.bin").read_bytes()
    report = json.loads((out / "report.json").read_text())
    assert report["refinement"]["outcome"] == "optimal"
    given, adjusted = report["refinement"]["candidates"][:2]
    assert (given["name"], given["is_kept"], adjusted["is_kept"]) == ("as given", True, False)
    assert adjusted["mean_px"] > 2 * given["mean_px"]
    assert CliRunner().invoke(app, [*command, "--force"]).exit_code == 0
    assert (out / "sparse/0/images.bin").read_bytes() != (model / "images.bin").read_bytes()


def test_without_one_edge_there_are_still_candidates(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    start = disturbed(model, tmp_path / "start")
    done = hodge_pipeline.refine_colmap(start, out=tmp_path / "out", overrides=[*FREE, "model.min_shared=100000"])
    assert done.results[0].decision.outcome == "refined"
    assert error_px(tmp_path / "out/sparse/0") <= 1.001 * error_px(model)


def test_points_that_one_image_saw_are_kept(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    odd = pycolmap.Reconstruction(disturbed(model, tmp_path / "start"))
    lost = min(odd.points3D)
    element = odd.points3D[lost].track.elements[0]
    image_id, column, xyz = element.image_id, element.point2D_idx, odd.points3D[lost].xyz.copy()
    odd.delete_point3D(lost)
    track = pycolmap.Track()
    track.add_element(image_id, column)
    lone = odd.add_point3D(xyz, track)
    done = hodge_pipeline.refine_colmap(odd, database="none", overrides=FREE)
    assert done.results[0].decision.outcome == "refined"
    assert done.models[0].points3D[lone].track.length() == 1


def test_lund_door(data_dir: Path, tmp_path: Path) -> None:
    model = data_dir / "colmap/lund_door/set1_lund_door/colmap_ground_truth"
    part = thinned(model, tmp_path / "part", 8)
    start = disturbed(part, tmp_path / "start")
    done = hodge_pipeline.refine_colmap(start, images="none", out=tmp_path / "out", overrides=FREE)
    assert done.results[0].decision.outcome == "refined"
    after = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert error_px(start) > 3 and error_px(tmp_path / "out/sparse/0") <= 1.001 * error_px(part)
    assert tracks(after) == tracks(pycolmap.Reconstruction(part))
    undisturbed = hodge_pipeline.refine_colmap(part, images="none", overrides=FREE).results[0].decision
    assert undisturbed.outcome == "optimal", "its poses are without a rig, but for rounding: the size is free"
