from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

import hodge_pipeline
from hodge_adapters.colmap import bundle, tracked
from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.scale import seen_depths
from hodge_adapters.colmap.tracked import ColmapModel
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import SourceError, WorkspaceError
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.refine import choice
from hodge_pipeline.refine.candidates import ADJUSTED, GIVEN, POINTS
from hodge_pipeline.refine.frame import in_frame_of
from hodge_pipeline.refine.scale import metric_scale
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Floats
from test_readers_colmap import synthetic

NOISE_PX = 0.3
FREE = ("executor.workers=0",)


def noisy(folder: Path, *, database: bool = False) -> Path:
    """A rig model with pixel noise at its own optimum, as `folder/model`."""
    synthetic(folder, database=database)
    model = pycolmap.Reconstruction(folder / "text")
    rng = np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(scale=NOISE_PX, size=2)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    return folder / "model"


def disturbed(model: Path, out: Path, degrees: float = 0.5, share: float = 0.02) -> Path:
    moved = pycolmap.Reconstruction(model)
    rng = np.random.default_rng(1)
    for frame_id in moved.reg_frame_ids():
        frame = moved.frames[frame_id]
        xi = rng.normal(size=6)
        xi[:3] *= np.radians(degrees) / np.linalg.norm(xi[:3])
        xi[3:] *= share * np.linalg.norm(frame.rig_from_world.translation) / np.linalg.norm(xi[3:])
        matrix = se3.exp(xi) @ np.vstack([frame.rig_from_world.matrix(), [0, 0, 0, 1]])
        frame.rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3]))
    out.mkdir()
    moved.write_text(out)
    return out


def thinned(good: Path, out: Path, keep: int) -> Path:
    """The model with one of so many of its points."""
    model = pycolmap.Reconstruction(good)
    for number, key in enumerate(sorted(model.points3D)):
        if number % keep:
            model.delete_point3D(key)
    out.mkdir()
    model.write(out)
    return out


def tracks(model: pycolmap.Reconstruction) -> dict[int, list[tuple[int, int]]]:
    return {
        key: sorted((element.image_id, element.point2D_idx) for element in point.track.elements)
        for key, point in model.points3D.items()
    }


def error_px(folder: Path) -> float:
    model = pycolmap.Reconstruction(folder)
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


@pytest.mark.parametrize("database", [False, True])
def test_disturbed_poses_come_back_with_every_rig_name_and_track(tmp_path: Path, database: bool) -> None:
    model = noisy(tmp_path, database=database)
    start = disturbed(model, tmp_path / "start")
    given = "auto" if database else "none"
    done = hodge_pipeline.refine_colmap(start, database=given, out=tmp_path / "out", overrides=FREE)
    assert done.exit_code == 0 and done.results[0].decision.outcome == "refined"
    assert [name for name, _ in done.results[0].candidates][:3] == [GIVEN, POINTS, ADJUSTED]
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


def test_points_that_are_wrong_beside_right_poses_are_mended_alone(tmp_path: Path) -> None:
    model, rng = pycolmap.Reconstruction(noisy(tmp_path)), np.random.default_rng(0)
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


def test_images_that_share_no_points_with_the_others_are_in_doubt() -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 60
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    apart = {image.name for image in sorted(model.images.values(), key=lambda one: one.name)[:3]}
    (whole,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert not whole.decision.doubt
    seen = {key: [(e.image_id, e.point2D_idx) for e in point.track.elements] for key, point in model.points3D.items()}
    for key, elements in seen.items():
        for image_id, column in elements:
            is_other = (model.images[image_id].name in apart) != (key % 2 == 0)
            if is_other and model.images[image_id].points2D[column].has_point3D():
                model.delete_observation(image_id, column)
    (cut,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert cut.decision.doubt.startswith("in doubt, since 3 images (")
    assert cut.decision.doubt.endswith("share no points with the others, or too few")


def test_positions_that_are_all_one_leave_the_size_as_it_is() -> None:
    """As of a camera that only turns: they tell no size, and poses of size 0 would be no numbers."""
    one = se3.from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), np.zeros((4, 3)))
    spread = se3.from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), np.eye(4)[:, :3])
    start, model = (SimpleNamespace(world_from_body=poses, body_from_cam=one) for poses in (one, spread))
    assert in_frame_of(start, model) is model  # type: ignore[arg-type]


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
    whole = choice.held_out_errors(model, model, False, 0, step=step).errors_px
    monkeypatch.setattr(choice, "ENOUGH_SEEN", 20)
    part = choice.held_out_errors(model, model, False, 0, step=step).errors_px
    most = 20 * model.quality.images * choice.OBSERVATIONS_HELD_OUT
    assert 0 < part.shape[1] < 1.5 * most < whole.shape[1]
    assert np.median(part[0]) == pytest.approx(np.median(whole[0]), rel=0.5)


def test_a_reconstruction_goes_in_and_comes_out_and_nothing_is_computed_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = noisy(tmp_path)
    start = pycolmap.Reconstruction(disturbed(model, tmp_path / "start"))
    counts = {name: Mock(wraps=getattr(tracked, name)) for name in ("content_of", "standard_errors")}
    for name, counted in counts.items():
        monkeypatch.setattr(tracked, name, counted)
    (refined,) = hodge_pipeline.refine_colmap(start, database="none", overrides=FREE).models
    assert {name: counted.call_count for name, counted in counts.items()} == {"content_of": 0, "standard_errors": 1}
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


def test_the_terminal_has_ten_lines_of_80_columns_and_verbose_has_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = noisy(tmp_path)
    command = ["refine", "colmap", str(model), "--out", "out", "--set", FREE[0], "--overwrite"]
    monkeypatch.chdir(tmp_path)
    verbose = CliRunner().invoke(app, [*command, "--verbose"])
    brief, whole = CliRunner().invoke(app, command).stdout.splitlines(), verbose.stdout
    assert "bundle adjustment: done" in verbose.stderr, "each step is told as it ends"
    assert brief[0].startswith("verdict  ") and brief[-1] == "report   out/report.html"
    assert len(brief) <= 10 and max(map(len, brief)) <= 80
    assert any("mean reprojection error" in line for line in brief)
    assert "candidate" in whole and "bundle adjustment" in whole and len(whole.splitlines()) > len(brief)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    for option in ("database", "depth"):
        with pytest.raises(SourceError, match="nowhere"):
            hodge_pipeline.refine_colmap(model, **{option: tmp_path / "nowhere"})
    (tmp_path / "depths").mkdir()
    with pytest.raises(SourceError, match="name the PNGs alike"):
        hodge_pipeline.refine_colmap(model, depth=tmp_path / "depths")
    with pytest.raises(SourceError, match="no COLMAP model"):
        hodge_pipeline.refine_colmap(tmp_path / "depths")
    with pytest.raises(WorkspaceError, match="give another"):
        hodge_pipeline.refine_colmap(model, out=model)


def test_a_model_without_an_observation_is_refused_and_nothing_written(tmp_path: Path) -> None:
    empty = pycolmap.Reconstruction(noisy(tmp_path))
    for key in list(empty.points3D):
        empty.delete_point3D(key)
    (tmp_path / "empty").mkdir()
    empty.write(tmp_path / "empty")
    with pytest.raises(SourceError, match="no point that two images saw"):
        hodge_pipeline.refine_colmap(tmp_path / "empty", out=tmp_path / "out", overrides=FREE)
    assert not (tmp_path / "out/sparse").exists()


def test_without_one_edge_there_are_still_candidates(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    start = disturbed(model, tmp_path / "start")
    done = hodge_pipeline.refine_colmap(start, out=tmp_path / "out", overrides=[*FREE, "model.min_shared=100000"])
    assert done.results[0].decision.outcome == "refined"
    assert error_px(tmp_path / "out/sparse/0") <= 1.001 * error_px(model)


def refuse(*_: object, **__: object) -> None:
    raise AssertionError("this was done before")


def stop(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def counted(patch: pytest.MonkeyPatch, method: str) -> list[object]:
    """One entry for each call of a method of models from now on."""
    calls, honest = list[object](), getattr(ColmapModel, method)

    def call(self: ColmapModel, *arguments: object, **named: object) -> object:
        calls.append(self)
        return honest(self, *arguments, **named)

    patch.setattr(ColmapModel, method, call)
    return calls


@pytest.mark.parametrize("text", [False, True])
def test_a_refinement_that_was_stopped_goes_on_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: bool
) -> None:
    start = disturbed(noisy(tmp_path), tmp_path / "start")
    if not text:
        as_text, start = start, tmp_path / "as_binary"
        start.mkdir()
        pycolmap.Reconstruction(as_text).write_binary(start)
    whole, out = tmp_path / "whole", tmp_path / "stopped"
    hodge_pipeline.refine_colmap(start, overrides=FREE, out=whole)
    with monkeypatch.context() as patch:
        patch.setattr(ColmapModel, "resected", stop)
        with pytest.raises(KeyboardInterrupt):
            hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    with monkeypatch.context() as patch:
        calls = counted(patch, "adjusted")
        hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
        held = [model for model in calls if isinstance(model, ColmapModel) and model.refine == "none"]
        assert len(held) == 1, "that of the model as given was done before"
    monkeypatch.setattr(ColmapModel, "adjusted", refuse)
    again = hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    assert again.results[0].decision.outcome == "refined"
    ending = "txt" if text else "bin"
    for name in ("poses.tum", f"sparse/0/images.{ending}", f"sparse/0/points3D.{ending}"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_a_model_that_changed_is_computed_anew_and_another_option_replaces_only_when_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, out = disturbed(noisy(tmp_path), tmp_path / "start"), tmp_path / "out"
    hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    other = [*FREE, "model.min_shared=20"]
    with pytest.raises(WorkspaceError, match="another refined model .model.min_shared was 30, is 20.: --overwrite"):
        hodge_pipeline.refine_colmap(start, overrides=other, out=out)
    pycolmap.Reconstruction(start).write_text(start)
    monkeypatch.setattr(ColmapModel, "adjusted", refuse)
    with pytest.raises(AssertionError, match="done before"):
        hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    with pytest.raises(AssertionError, match="done before"):
        hodge_pipeline.refine_colmap(start, overrides=other, out=out, overwrite=True)


def test_a_refined_model_and_a_run_never_share_a_folder(tmp_path: Path) -> None:
    model, out = noisy(tmp_path), tmp_path / "out"
    hodge_pipeline.refine_colmap(model, overrides=FREE, out=out)
    with pytest.raises(WorkspaceError, match="holds a refined model: give another --out"):
        hodge_pipeline.run("demo", out, source=tmp_path)
    with pytest.raises(WorkspaceError, match="hodge diagnose .* judges its edges"):
        listed_edges(out)
    run = tmp_path / "run"
    (run / "stages").mkdir(parents=True)
    with pytest.raises(WorkspaceError, match="holds a run: give another --out"):
        hodge_pipeline.refine_colmap(model, overrides=FREE, out=run)


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


def depths(ratios: Floats, rays: Floats | None = None) -> Floats:
    """Depths (K, 3) of points with these ratios (K,) of metres to units, by a sensor that may measure along rays."""
    model = np.random.default_rng(5).permutation(np.linspace(1.0, 4.0, len(ratios)))
    ray = np.ones(len(ratios)) if rays is None else rays
    return np.stack([ratios * model * ray, model, ray], axis=1)


def test_depth_that_tells_no_scale_is_a_doubt_and_depth_that_cannot_be_read_an_error(tmp_path: Path) -> None:
    assert metric_scale([]).doubt == "" and metric_scale([depths(np.full(60, 2.0))] * 3).doubt == ""
    assert metric_scale([np.zeros((0, 3))] * 3).doubt == "not in metres, since depth at only 0 points of 0 images"
    file = tmp_path / "0.png"
    cv2.imwrite(str(file), np.full((4, 4), 9, np.uint8))
    synthetic(tmp_path)
    with pytest.raises(SourceError, match="0.png: depth must be uint16"):
        seen_depths(read_model(tmp_path / "binary")[1], {0: file}, 1000.0, (0,))


def test_scale_is_the_median_with_the_error_of_the_images_medians() -> None:
    rng = np.random.default_rng(0)
    bias = rng.normal(scale=0.01, size=40)
    ratios = [0.2 * (1 + one + rng.normal(scale=0.03, size=100)) for one in bias]
    ratios[0][:20] = 5.0
    scale = metric_scale([depths(one) for one in ratios])
    assert abs(scale.metres_per_unit / 0.2 - 1) < 3 * scale.sigma
    assert 0.001 < scale.sigma < 0.004, "0.01 · 1.25 / √40 = 0.002"
    assert not metric_scale([]).is_observable
    assert "only 20 points" in metric_scale([depths(np.ones(10)), depths(np.ones(10))]).reason


def test_depth_that_is_not_of_these_images_tells_no_scale() -> None:
    """Depth of a mirrored or another image of one room is nearer to the points than chance, and tells a wrong scale."""
    rng = np.random.default_rng(0)
    right = [0.2 * (1 + rng.normal(scale=0.03, size=100)) for _ in range(10)]
    for scale, told in ((0.5, True), (0.17, True), (0.03, False)):
        found = metric_scale([depths(0.2 * np.exp(rng.normal(scale=scale, size=100))) for _ in range(10)])
        assert ("depth of other images" in found.reason) == told, scale
    halved = metric_scale([depths(one if row % 3 else one / 2) for row, one in enumerate(right)])
    assert halved.reason == "the depth of 4 of 10 images is 0.51 times what the others' scale gives"
    along = metric_scale([depths(one, 1 + 0.3 * rng.random(100)) for one in right])
    assert along.reason.startswith("depth seems to be measured along rays")


def test_lund_door(data_dir: Path, tmp_path: Path) -> None:
    model = data_dir / "colmap/lund_door/set1_lund_door/colmap_ground_truth"
    part = thinned(model, tmp_path / "part", 8)
    start = disturbed(part, tmp_path / "start")
    done = hodge_pipeline.refine_colmap(start, images="none", out=tmp_path / "out", overrides=FREE)
    assert done.results[0].decision.outcome == "refined"
    after = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert error_px(start) > 3 and error_px(tmp_path / "out/sparse/0") <= 1.001 * error_px(part)
    assert tracks(after) == tracks(pycolmap.Reconstruction(part))
    undisturbed = hodge_pipeline.refine_colmap(model, images="none", overrides=FREE).results[0].decision
    assert undisturbed.outcome == "optimal", "its poses are without a rig, but for rounding: the size is free"


def test_a_principal_point_that_tracks_contradict_is_a_doubt(tmp_path: Path) -> None:
    """Poses turn to make up for it, and free focal lengths explain little of what is left."""
    model = pycolmap.Reconstruction(noisy(tmp_path))
    for camera in model.cameras.values():
        camera.params = camera.params + np.array([0.0, 40.0, -30.0, 0.0])
    (result,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert "principal points moved by" in result.decision.doubt and result.decision.doubt.endswith("--refine all")


def test_sub_models_are_found(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    for number in ("10", "2"):
        (tmp_path / "scene/sparse" / number).mkdir(parents=True)
        for file in model.iterdir():
            (tmp_path / "scene/sparse" / number / file.name).write_bytes(file.read_bytes())
    found = ColmapModels().open_models(tmp_path / "scene")
    assert [Path(one.name).name for one in found] == ["2", "10"]


@pytest.mark.parametrize("refine", ["none", "focal", "all"])
def test_intrinsics_are_held_unless_they_are_to_be_refined(tmp_path: Path, refine: str) -> None:
    good = pycolmap.Reconstruction(noisy(tmp_path))
    long = pycolmap.Reconstruction(good)
    for camera in long.cameras.values():
        camera.params = camera.params * np.array([1.02, 1, 1, 1])
    options = (*FREE, f"model.refine={refine}", "model.database=none")
    (result,) = hodge_pipeline.refine_colmap(long, overrides=options).results
    assert result.decision.outcome == "refined"
    for key, camera in result.model.native.cameras.items():
        params, before = camera.params, long.cameras[key].params
        focal = good.cameras[key].params[0]
        assert abs(params[0] / focal - 1) < 5e-3 if refine != "none" else params[0] == before[0]
        assert (params[1] == before[1]) == (refine != "all") and (params[3] == before[3]) == (refine != "all")
    notes = " ".join(result.notes)
    assert ("contradict the intrinsics (focal lengths of 2 cameras changed by" in result.decision.doubt) == (
        refine == "none"
    )
    assert ("intrinsics are held: --refine" in notes) == (refine == "none")
    assert ("focal lengths of 2 cameras changed by" in notes) == (refine != "none")


def test_a_rig_that_tracks_contradict_is_named_and_refined_where_that_is_asked_for(tmp_path: Path) -> None:
    """Not the focal lengths, which bend to make up for it."""
    good = pycolmap.Reconstruction(noisy(tmp_path))
    turned = pycolmap.Reconstruction(good)
    (rig,) = turned.rigs.values()
    (sensor,) = rig.non_ref_sensors
    rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(se3.exp([0, 0.03, 0, 0, 0, 0])[:3]) * rig.sensor_from_rig(sensor))
    (result,) = hodge_pipeline.refine_colmap(turned, database="none", overrides=FREE).results
    assert "contradict the rig's calibration (cameras turned in their rigs by up to 1.7°" in result.decision.doubt
    (model,) = ColmapModels(database="none", refine="rig").open_models([turned])
    found = model.adjusted().native.rigs[rig.rig_id].sensor_from_rig(sensor)
    np.testing.assert_allclose(found.matrix(), good.rigs[rig.rig_id].sensor_from_rig(sensor).matrix(), atol=5e-3)
