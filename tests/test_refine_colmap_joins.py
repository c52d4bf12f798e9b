from __future__ import annotations

import shutil
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, noisy
from hodge_adapters.colmap.models import ColmapModels
from hodge_pipeline import se3
from hodge_pipeline.evaluation.trajectory import absolute_error
from readers_data import write_depth

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))


def poses_by_name(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    images = (model.images[key] for key in model.reg_image_ids())
    return {image.name: np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]) for image in images}


def distance(found: pycolmap.Reconstruction, truth: pycolmap.Reconstruction, with_scale: bool = True) -> float:
    """ATE as a share of the spread of the true positions."""
    there, here = poses_by_name(truth), poses_by_name(found)
    assert there.keys() == here.keys()
    true = np.array([there[name] for name in sorted(there)])
    spread = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(axis=0), axis=1).mean()
    return absolute_error(np.array([here[name] for name in sorted(here)]), true, with_scale=with_scale).rmse_m / spread


def cut(model: Path, out: Path, similarity: pycolmap.Sim3d) -> None:
    """The model as two, `out/0` and `out/1`, of half its frames each, the second in another gauge and unit."""
    whole = pycolmap.Reconstruction(model)
    frames = sorted(whole.reg_frame_ids())
    half = len(frames) // 2
    for number, left_out in enumerate((frames[half:], frames[:half])):
        part = pycolmap.Reconstruction(whole)
        for frame_id in left_out:
            part.deregister_frame(frame_id)
        if number:
            part.transform(similarity)
        (out / str(number)).mkdir(parents=True)
        part.write(out / str(number))


def broken_chain(model: Path, out: Path, xi: np.ndarray) -> None:
    """Each body off from the one before by the twist; tracks cut into pairs of neighbours, so nothing closes it."""
    whole = pycolmap.Reconstruction(model)
    frames = sorted(whole.reg_frame_ids())
    order = {image.id: row for row, key in enumerate(frames) for image in whole.frames[key].image_ids}
    old = [np.vstack([whole.frames[key].rig_from_world.inverse().matrix(), [0, 0, 0, 1]]) for key in frames]
    new = [old[0]]
    for before, after in zip(old[:-1], old[1:], strict=True):
        new.append(new[-1] @ se3.inverse(before) @ after @ se3.exp(xi))
    tracks = [(point.xyz.copy(), list(point.track.elements)) for point in whole.points3D.values()]
    elements = [(xyz, [(order[e.image_id], e.image_id, e.point2D_idx) for e in track]) for xyz, track in tracks]
    for key in list(whole.points3D):
        whole.delete_point3D(key)
    for key, pose in zip(frames, new, strict=True):
        whole.frames[key].rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(se3.inverse(pose)[:3]))
    for xyz, track in elements:
        for row in range(0, len(frames), 2):
            part = pycolmap.Track()
            for at, image_id, column in track:
                if at in (row, row + 1):
                    part.add_element(image_id, column)
            if part.length() >= 2:
                whole.add_point3D(se3.transform(new[row] @ se3.inverse(old[row]), xyz[None])[0], part)
    out.mkdir(parents=True)
    whole.write(out)


def sparse_depth(model: Path, out: Path, metres_per_unit: float) -> None:
    """Depth images that know the model's points and nothing else."""
    made = pycolmap.Reconstruction(model)
    for image in made.images.values():
        depth = np.zeros((768, 1024), np.uint16)
        for point in image.points2D:
            if point.has_point3D():
                z = (image.cam_from_world() * made.points3D[point.point3D_id].xyz)[2]
                column, row = np.floor(point.xy).astype(int)
                if 0 <= row < 768 and 0 <= column < 1024:
                    depth[row, column] = np.clip(round(z * 1000 * metres_per_unit), 0, 65000)
        write_depth(out / image.name, depth)


TURN = pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.3, 0.5, -0.2])), np.array([1.0, 2.0, 3.0]))


def test_two_models_of_one_scene_are_joined_by_the_database(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    cut(model, tmp_path / "sparse", TURN)
    done = hodge_pipeline.refine_colmap(tmp_path / "sparse", out=tmp_path / "out", overrides=FREE)
    assert [result.decision.outcome for result in done.results] == ["refined"]
    whole, joined = pycolmap.Reconstruction(model), pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert not (tmp_path / "out/sparse/1").exists()
    assert joined.num_rigs() == whole.num_rigs() and joined.num_cameras() == whole.num_cameras()
    assert joined.num_reg_frames() == whole.num_reg_frames()
    assert distance(joined, whole) < 2e-3
    assert joined.num_points3D() == pytest.approx(whole.num_points3D(), rel=0.05), "tracks are one again"
    assert any("joined" in note for note in done.results[0].notes)


def test_models_that_nothing_ties_stay_two(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    cut(model, tmp_path / "sparse", TURN)
    done = hodge_pipeline.refine_colmap(tmp_path / "sparse", out=tmp_path / "out", overrides=FREE)
    assert len(done.results) == 2 and (tmp_path / "out/sparse/1/images.bin").is_file()
    assert {result.decision.outcome for result in done.results} <= {"optimal", "refined"}


def test_a_model_that_joins_nothing_comes_out_once_though_it_shares_the_name_of_an_image(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    cut(model, tmp_path / "sparse", TURN)
    shared = pycolmap.Reconstruction(model).images[1].name
    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D = 5, 100
    pycolmap.set_random_seed(1)
    other = pycolmap.synthesize_dataset(options)
    for image in other.images.values():
        image.name = shared if image.image_id == 1 else f"other/{image.name}"
    (tmp_path / "sparse/2").mkdir()
    other.write(tmp_path / "sparse/2")
    done = hodge_pipeline.refine_colmap(tmp_path / "sparse", out=tmp_path / "out", overrides=FREE)
    assert [[Path(one.name).name for one in result.inputs] for result in done.results] == [["2"], ["0", "1"]]
    assert [result.decision.outcome for result in done.results] == ["optimal", "refined"]
    written = [pycolmap.Reconstruction(folder) for folder in sorted((tmp_path / "out/sparse").iterdir())]
    assert [one.num_reg_images() for one in written] == [10, 8]
    assert shared in poses_by_name(written[0]) and shared in poses_by_name(written[1])


def test_a_broken_chain_is_closed_by_what_the_database_matched(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    broken_chain(model, tmp_path / "chain", np.array([0.01, -0.02, 0.01, 0.02, 0.05, -0.03]))
    before = distance(pycolmap.Reconstruction(tmp_path / "chain"), pycolmap.Reconstruction(model))
    done = hodge_pipeline.refine_colmap(tmp_path / "chain", overrides=FREE)
    assert done.results[0].decision.outcome == "refined"
    assert before > 0.01 and distance(done.models[0], pycolmap.Reconstruction(model)) < 2e-3


def test_wrong_matches_in_the_database_do_no_harm(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    broken_chain(model, tmp_path / "chain", np.array([0.01, -0.02, 0.01, 0.02, 0.05, -0.03]))
    connection, rng = sqlite3.connect(tmp_path / "database.db"), np.random.default_rng(0)
    rows = connection.execute("SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0").fetchall()
    with connection:
        for row in rng.permutation(len(rows))[: round(0.1 * len(rows))]:
            pair_id, count, data = rows[row]
            matches = np.frombuffer(data, "<u4").reshape(count, 2).copy()
            matches[:, 1] = rng.permutation(matches[:, 1])
            change = "UPDATE two_view_geometries SET data = ? WHERE pair_id = ?"
            connection.execute(change, (matches.tobytes(), pair_id))
    connection.close()
    done = hodge_pipeline.refine_colmap(tmp_path / "chain", overrides=FREE)
    assert distance(done.models[0], pycolmap.Reconstruction(model)) < 2e-3


def test_depth_makes_the_model_metric(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    sparse_depth(model, tmp_path / "depth", 0.3)
    options = {"depth": tmp_path / "depth", "overrides": FREE}
    done = hodge_pipeline.refine_colmap(model, out=tmp_path / "out", **options)
    scale = done.results[0].scales[0]
    assert done.results[0].decision.outcome == "refined"
    assert scale.metres_per_unit == pytest.approx(0.3, rel=5e-3)
    whole = pycolmap.Reconstruction(model)
    whole.transform(pycolmap.Sim3d(0.3, pycolmap.Rotation3d(), np.zeros(3)))
    assert distance(done.models[0], whole, with_scale=False) < 5e-3
    given, metric = (
        np.mean(list(poses_by_name(one).values()), axis=0)[:3, 3]
        for one in (pycolmap.Reconstruction(model), done.models[0])
    )
    np.testing.assert_allclose(metric, given, atol=0.05, err_msg="it is scaled where it stands")
    again = hodge_pipeline.refine_colmap(tmp_path / "out", **options)
    assert again.results[0].decision.outcome == "optimal", "what is metric and optimal is left alone"


def test_depth_of_other_images_is_not_believed(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    sparse_depth(model, tmp_path / "right", 0.3)
    names = sorted(path.relative_to(tmp_path / "right") for path in (tmp_path / "right").rglob("*.png"))
    rng = np.random.default_rng(0)
    for name in names:
        write_depth(tmp_path / "wrong" / name, rng.integers(300, 9000, (768, 1024)).astype(np.uint16))
    done = hodge_pipeline.refine_colmap(model, depth=tmp_path / "wrong", out=tmp_path / "out", overrides=FREE)
    assert "depth of other images" in done.results[0].scales[0].reason
    assert done.results[0].decision.keeps_input
    for path in model.iterdir():
        assert (tmp_path / "out/sparse/0" / path.name).read_bytes() == path.read_bytes()


def test_a_database_of_other_images_is_said_to_be_one(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    connection = sqlite3.connect(tmp_path / "database.db")
    with connection:
        connection.execute("UPDATE images SET name = 'other/' || name")
    connection.close()
    (result,) = hodge_pipeline.refine_colmap(model, out=tmp_path / "out", overrides=FREE).results
    assert any("none of the model's" in note for note in result.notes)
    (opened,) = ColmapModels().open_models(model)
    assert set(opened.measured()[0].source) == {"structure"}


def test_a_database_of_old_is_left_out_with_a_note(tmp_path: Path) -> None:
    model = noisy(tmp_path, database=True)
    connection = sqlite3.connect(tmp_path / "database.db")
    with connection:
        connection.execute("ALTER TABLE two_view_geometries RENAME TO inlier_matches")
    connection.close()
    (opened,) = ColmapModels().open_models(model)
    assert any("no two_view_geometries" in note for note in opened.notes)
    assert set(opened.measured()[0].source) == {"structure"} and opened.held_apart == 0


def test_images_without_a_pose_stay_without(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    part = pycolmap.Reconstruction(model)
    lost = sorted(part.reg_frame_ids())[-1]
    part.deregister_frame(lost)
    (tmp_path / "part").mkdir()
    part.write(tmp_path / "part")
    done = hodge_pipeline.refine_colmap(tmp_path / "part", out=tmp_path / "out", overrides=FREE)
    written = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert done.exit_code == 0 and written.num_reg_images() == part.num_reg_images()
    assert written.num_images() == pycolmap.Reconstruction(tmp_path / "part").num_images()


def test_a_real_model_of_red_kitchen(data_dir: Path, tmp_path: Path) -> None:
    from make_colmap_model import colour_images, make_model

    from hodge_adapters.colmap.reader import ColmapReader

    images = colour_images(data_dir / "seven_scenes/redkitchen/seq-01")[:30:5]
    assert make_model(images, tmp_path, (585, 585, 320, 240), features=1500) == 1
    theirs = pycolmap.Reconstruction(tmp_path / "sparse/0")
    ours = ColmapReader(edges="none", scale=1.0).open(tmp_path / "sparse/0")
    assert len(ours.frames) == len(images) == theirs.num_reg_images()
    for frame in ours.frames:
        np.testing.assert_allclose(frame.world_from_cam, poses_by_name(theirs)[frame.frame_id], atol=1e-12)
        assert frame.read_depth is not None
    out = tmp_path / "out"
    done = hodge_pipeline.refine_colmap(tmp_path / "sparse/0", depth=tmp_path / "depth", out=out, overrides=FREE)
    assert done.results[0].decision.outcome == "refined"
    refined = pycolmap.Reconstruction(out / "sparse/0")
    poses = poses_by_name(refined)
    truth = [np.loadtxt(path.with_name(path.name.replace("color.jpg", "pose.txt"))) for path in images]
    assert absolute_error(np.array([poses[path.name] for path in images]), np.array(truth)).rmse_m < 0.03
    refined.update_point_3d_errors()
    assert refined.compute_mean_reprojection_error() <= 1.0001 * theirs.compute_mean_reprojection_error()
    shutil.rmtree(out)
