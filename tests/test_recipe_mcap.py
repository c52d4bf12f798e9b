"""The recipes for recordings: what comes out is what comes out of the folder that the recording was made from."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.trajectories.text import write_tum
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.types import Trajectory
from mcap_data import COMPRESSED, RAW, compressed_depth, compressed_inverse_depth, png, raw_image
from mcap_encoding import CDR, ENCODINGS
from mcap_scene import stamp_s, write_clouds, write_rgbd
from readers_data import points_in_cam
from synthetic import tiny_sequence  # noqa: F401 - a fixture

LIGHT = ("clouds.voxel_m=0.1", "executor.workers=0", "recording.level=off", "evaluation.tables=false")


def in_metres(stored: np.ndarray) -> np.ndarray:
    return np.where(stored == 65535, 0, stored).astype(np.float32) * np.float32(1e-3)


EXACT = {
    "16UC1 raw": (RAW, lambda image: raw_image(image, "16UC1")),
    "16UC1 png": (COMPRESSED, lambda image: compressed_depth(image, "png")),
    "16UC1 rvl": (COMPRESSED, lambda image: compressed_depth(image, "rvl")),
    "16UC1 bare png": (COMPRESSED, lambda image: {"format": "png", "data": png(image)}),
    "32FC1 raw": (RAW, lambda image: raw_image(in_metres(image), "32FC1")),
}


@pytest.mark.parametrize(("form", "encoding"), list(itertools.product(EXACT, ENCODINGS)))
def test_the_very_clouds_of_a_real_scene(form: str, encoding: str, data_dir: Path, tmp_path: Path) -> None:
    frame = SevenScenesReader(colour_camera="same").open(data_dir / "seven_scenes/redkitchen").frames[0]
    path = write_rgbd(tmp_path / "log.mcap", [frame], *EXACT[form], encoding)
    (logged,) = McapReader(no_depth=(0, 65535)).open(path).frames
    found, expected = (make_cloud(one, CloudOptions())[0] for one in (logged, frame))
    np.testing.assert_array_equal(found.points_in_cam, expected.points_in_cam)
    np.testing.assert_array_equal(found.normals_in_cam, expected.normals_in_cam)
    np.testing.assert_array_equal(found.colours, expected.colours)


def test_inverse_depth_within_its_steps(data_dir: Path, tmp_path: Path) -> None:
    frame = SevenScenesReader().open(data_dir / "seven_scenes/redkitchen").frames[0]

    def coded(stored: np.ndarray) -> dict[str, object]:
        return compressed_inverse_depth(in_metres(stored))

    path = write_rgbd(tmp_path / "log.mcap", [frame], COMPRESSED, coded)
    (logged,) = McapReader().open(path).frames
    assert logged.read_depth and frame.read_depth
    found, expected = logged.read_depth(), frame.read_depth()
    np.testing.assert_array_equal(found > 0, expected > 0)
    assert (np.abs(found - expected) <= expected**2 / 10100 * 1.01 + 1e-5).all()


def test_a_recording_gives_the_poses_of_its_folder(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    frames = TumReader(every=2).open(tiny_sequence).frames
    log = write_rgbd(tmp_path / "log.mcap", frames, COMPRESSED, compressed_depth, CDR)
    runs = []
    for name, source, reader in (
        ("tum", tiny_sequence, "source.reader.every=2"),
        ("mcap", log, "source.reader.depth_scale=5000"),
    ):
        recipe = load_recipe(name, [*LIGHT, "fusion=[{stage: tsdf, voxel_m: 0.1, min_weight: 1}]", reader], source)
        runs.append(hodge_pipeline.run(recipe, tmp_path / name))
    folder, recording = runs
    assert recording.report.before == "start" and not recording.report.trajectories, "/tf is no truth"
    np.testing.assert_allclose(recording.result.world_from_cam, folder.result.world_from_cam, atol=1e-6)
    assert folder.report.trajectories
    assert (tmp_path / "mcap/mesh.ply").stat().st_size > 10000


def test_a_recording_of_clouds(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    frames = TumReader(every=2).open(tiny_sequence).frames
    clouds = [points_in_cam(frame.read_depth(), frame.camera, 1) for frame in frames if frame.read_depth]
    log = write_clouds(tmp_path / "log.mcap", frames, clouds)
    sets = (*LIGHT, "evaluation.tables=true")
    run = hodge_pipeline.run(load_recipe("mcap_clouds", sets, log), tmp_path / "run")
    assert run.scores is not None and run.scores.names[:2] == ("start", "odometry") and run.scores.reference == "result"
    page = (tmp_path / "run/report.html").read_text()
    assert "against start" in page and "(ATE" not in page and "no true poses" in page
    assert (tmp_path / "run/cloud.ply").is_file()


def test_a_truth_that_is_named_is_one(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    frames = TumReader(every=4).open(tiny_sequence).frames
    clouds = [points_in_cam(frame.read_depth(), frame.camera, 1) for frame in frames if frame.read_depth]
    log = write_clouds(tmp_path / "log.mcap", frames, clouds)
    rows = {}
    elsewhere = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    poses = elsewhere @ np.array([frame.world_from_cam for frame in frames])
    write_tum(tmp_path / "true.txt", Trajectory(np.array([stamp_s(frame) for frame in frames]), poses))
    for truth in ("frames", str(tmp_path / "true.txt")):
        sets = (*LIGHT, "fusion=[]", f"evaluation.truth={truth}")
        run = hodge_pipeline.run(load_recipe("mcap_clouds", sets, log), tmp_path / "run", overwrite=True)
        rows[truth] = {row.name: row.ate_rmse_m for row in run.report.trajectories}
        again = hodge_pipeline.Run.load(tmp_path / "run").source
        assert all(frame.true_world_from_cam is not None for frame in again.frames)
    own, file = rows.values()
    assert file["result"] == pytest.approx(own["result"], rel=1e-6)
    assert file["start"] < 1e-6 and "start" not in own, "poses that are the truth are not compared with it"
