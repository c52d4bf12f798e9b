"""A COLMAP model reviewed: its bodies and points, decisions beside it, the adjusted model in a folder of its own."""

import re
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import align
from hodge_pipeline.pairs.edits import read_history
from hodge_pipeline.review.keeping import save
from hodge_pipeline.review.listing import Query, describe, list_edges, state
from hodge_pipeline.review.opening import Review
from hodge_pipeline.review.routes import PictureCache
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.types import Floats
from hodge_pipeline.uses.diagnosed import diagnose_subject, open_subject
from test_readers_colmap_rigs import write_model


def synthetic(folder: Path, cameras: int, *, turned: bool = False) -> Path:
    """A model of eight frames of a rig that see the same points; `turned`: one frame is 15 degrees off."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=cameras, num_frames_per_rig=8, num_points3D=250
    )
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    if turned:
        frame = model.frames[min(model.frames)]
        off = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.deg2rad(15), 0])), np.array([0.2, 0, 0]))
        frame.rig_from_world = off * frame.rig_from_world
    for point in model.points3D.values():
        point.color = np.array([10, 20, 30], np.uint8)
    folder.mkdir()
    model.write_binary(folder)
    return folder


def test_poses_that_contradict_consistent_edges_are_told(tmp_path: Path) -> None:
    good = diagnose_subject(open_subject(synthetic(tmp_path / "good", 1)))
    off = diagnose_subject(open_subject(synthetic(tmp_path / "off", 1, turned=True)))
    assert good.sentence == off.sentence and good.sentence.endswith("are consistent with each other.")
    told = "the poses given contradict 7 of the 28 edges kept, most of those of camera000001_frame000000.png: "
    assert off.notes[0].startswith(told) and not any("contradict" in note for note in good.notes)


def centres(folder: Path) -> dict[str, Floats]:
    """The centre of each image."""
    model = pycolmap.Reconstruction(folder)
    return {image.name: image.projection_center() for image in model.images.values()}


@pytest.mark.parametrize("cameras", [1, 2])
def test_bodies_see_their_points_where_the_model_has_them(tmp_path: Path, cameras: int) -> None:
    folder = synthetic(tmp_path / "model", cameras)
    subject = open_for_review(folder)
    assert subject.graph.vertex_count == 8 and subject.clouds is not None and subject.unit == "units"
    known = np.array([point.xyz for point in pycolmap.Reconstruction(folder).points3D.values()])
    poses = subject.model.world_from_body  # type: ignore[union-attr]
    for cloud, pose in zip(subject.clouds, poses, strict=True):
        seen = se3.transform(pose, np.asarray(cloud.points_in_cam, float))
        assert len(seen) > 50 and np.abs(seen[:, None] - known).max(axis=2).min(axis=1).max() < 1e-4
    assert np.array_equal(np.unique(subject.clouds.colours, axis=0), [[10, 20, 30]])
    onto = align(subject.solution.world_from_cam, poses)
    assert np.abs(onto.apply(subject.solution.world_from_cam) - poses).max() < 1e-3


@pytest.mark.parametrize("cameras", [1, 2])
def test_decisions_are_kept_and_the_adjusted_model_is_written_beside_it(tmp_path: Path, cameras: int) -> None:
    right, folder = synthetic(tmp_path / "right", cameras), synthetic(tmp_path / "model", cameras, turned=True)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with Review(folder, scene=False, who="ada") as review:
        session = review.session
        session.wait()
        pair = session.names([3])[0]
        session.decide(0, "disable", [3])
        session.wait()
        assert (session.settled.weights[session.rows_of(pair)] == 0).all()
        said = [str(list_edges(session, Query())), str(describe(session, 5))]
        said += [one.caption for one in PictureCache(session).of(5)]
        assert "units" in said[0] and not [text for text in said if re.search(r"\d [cm]?m\b", text)]
        assert state(session)["finish"] == "adjust and save as COLMAP model" and describe(session, 3)["name"] == pair
        path, told = save(session)
        assert save(session)[0] == tmp_path / "model.reviewed-2"
    assert path == tmp_path / "model.reviewed" and "mean reprojection error" in told and "worse" not in told
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert read_history(folder / "edits.json").disabled == read_history(path / "edits.json").disabled == (pair,)
    truth, found = centres(right), centres(path / "sparse/0")
    assert found.keys() == truth.keys()
    poses = [np.tile(np.eye(4), (len(truth), 1, 1)) for _ in range(2)]
    poses[0][:, :3, 3], poses[1][:, :3, 3] = ([one[name] for name in sorted(truth)] for one in (found, truth))
    onto = align(poses[0], poses[1], with_scale=True).apply(poses[0])
    assert np.abs(onto - poses[1])[:, :3, 3].max() < 1e-3 * np.ptp(poses[1][:, :3, 3])
    with Review(folder, scene=False) as again:
        again.session.wait()
        assert (again.session.settled.weights[again.session.rows_of(pair)] == 0).all()


def test_a_model_without_points_is_refused_in_one_line(tmp_path: Path) -> None:
    model = write_model(tmp_path / "model")
    (model / "points3D.txt").write_text("")
    before = sorted(model.iterdir())
    with pytest.raises(SourceError) as refused:
        Review(model, scene=False)
    assert str(model) in str(refused.value) and "\n" not in str(refused.value) and sorted(model.iterdir()) == before
