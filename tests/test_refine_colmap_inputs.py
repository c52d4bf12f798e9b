"""What `hodge refine colmap` and the reader say to several models, to models too small, and to files that disagree."""

from __future__ import annotations

import csv
import re
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from matplotlib.axis import Axis
from typer.testing import CliRunner

import hodge_pipeline
from colmap_data import FREE, disturbed, noisy, synthetic
from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.colmap.writer import ColmapWriter
from hodge_pipeline.cli.main import app
from hodge_pipeline.cli.refine_colmap import _lines
from hodge_pipeline.errors import CheckError, SourceError
from hodge_pipeline.store.edge_table import read_edges
from readers_data import write_colour

NO_TRACKS = "set tracks=false"


def cut(model: Path, out: Path, frames: int) -> int:
    """The model with its first frames alone; how many images have a pose."""
    part = pycolmap.Reconstruction(model)
    for frame_id in sorted(part.reg_frame_ids())[frames:]:
        part.deregister_frame(frame_id)
    out.mkdir(parents=True)
    part.write(out)
    return int(part.num_reg_images())


@pytest.fixture
def sparse(tmp_path: Path) -> Path:
    """A scene's `sparse` with `0` of one image and `1` of all eight frames of one camera."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 8, 150
    pycolmap.set_random_seed(0)
    whole = tmp_path / "scene/sparse/1"
    whole.mkdir(parents=True)
    pycolmap.synthesize_dataset(options).write(whole)
    assert cut(whole, tmp_path / "scene/sparse/0", 1) == 1
    return whole.parent


def test_several_models_are_all_named_with_their_images_and_the_largest_is_taken(sparse: Path) -> None:
    named = f"2 models in {sparse}: 0 (1 image), 1 (8 images)"
    source = ColmapReader(edges="none").open(sparse.parent)
    assert len(source.frames) == 8 and source.notes[0].startswith(f"{named}: 1 is taken")
    found = ColmapModels().open_models(sparse.parent)
    assert [any(line.startswith(named) for line in one.notes) for one in found] == [False, True]


def test_one_image_is_refused_alone_and_left_out_beside_others(sparse: Path) -> None:
    with pytest.raises(SourceError, match="0: the model has one image with a pose") as refused:
        hodge_pipeline.refine_colmap(sparse / "0", overrides=FREE)
    assert "\n" not in str(refused.value)
    (result,) = hodge_pipeline.refine_colmap(sparse, overrides=FREE).results
    assert result.start.name == str(sparse / "1")
    named = " ".join(" ".join(_lines(result, alone=False, verbose=False)).split())
    assert named.startswith(f"of {sparse / '1'} (8 images) verdict "), "of several models each verdict names its own"
    assert [note for note in result.notes if note.startswith(f"left out: {sparse / '0'}: the model has one image")]


def test_a_model_without_its_images_or_cameras_names_the_file_that_is_not_there(sparse: Path) -> None:
    (sparse / "0/images.bin").unlink()
    left_out = f"left out: a COLMAP model without {sparse / '0/images.bin'}: copy that file too"
    (whole,) = ColmapModels().open_models(sparse)
    assert left_out in whole.notes
    for folder in (sparse, sparse.parent):
        opened = hodge_pipeline.open_source(folder)
        assert len(opened.frames) == 8 and left_out in opened.notes
    assert not any("left out" in note for one in ColmapModels().open_models(sparse / "1") for note in one.notes)
    (sparse / "1/cameras.bin").unlink()
    for folder, name in (
        (sparse.parent, "0/images.bin"),
        (sparse / "0", "0/images.bin"),
        (sparse / "1", "1/cameras.bin"),
    ):
        for read in (hodge_pipeline.open_source, hodge_pipeline.refine_colmap):
            with pytest.raises(SourceError, match=f"a COLMAP model without {sparse / name}: copy that file too"):
                read(folder)


def test_models_without_an_observation_are_refused_in_one_line(sparse: Path) -> None:
    empty = pycolmap.Reconstruction(sparse / "1")
    for key in list(empty.points3D):
        empty.delete_point3D(key)
    empty.write(sparse / "1")
    with pytest.raises(SourceError) as refused:
        hodge_pipeline.refine_colmap(sparse, overrides=FREE)
    told = str(refused.value)
    assert f"{sparse / '0'}: the model has one image" in told and f"{sparse / '1'}: the model has no point" in told
    assert "\n" not in told


def test_points_that_are_not_finite_are_left_out_and_noted(sparse: Path) -> None:
    spoiled = pycolmap.Reconstruction(sparse / "1")
    for key in sorted(spoiled.points3D)[:2]:
        spoiled.points3D[key].xyz = np.array([np.nan, 0.0, np.inf])
    count = spoiled.num_points3D()
    spoiled.write(sparse / "1")
    note = "2 points not finite: left out"
    assert note in ColmapReader(edges="none").open(sparse / "1").notes
    for given in (sparse / "1", spoiled):
        (result,) = hodge_pipeline.refine_colmap(given, overrides=FREE).results
        assert result.start.quality.points == count - 2 and note in result.notes
    assert spoiled.num_points3D() == count


def test_only_features_of_points_must_be_finite(sparse: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(sparse / "1")
    image = model.images[min(model.images)]
    next(point for point in image.points2D if not point.has_point3D()).xy = np.array([np.nan, np.nan])
    model.write_text(tmp_path)  # COLMAP undistorts to NaN what lies beyond its lens model
    with pytest.raises(SourceError, match=r"images\.txt:6: `nan`: expected a number: .* give the model as \.bin"):
        read_model(tmp_path)
    model.write(sparse / "1")
    (result,) = hodge_pipeline.refine_colmap(sparse / "1", overrides=FREE).results
    assert result.start.quality.points == model.num_points3D()
    next(point for point in image.points2D if point.has_point3D()).xy = np.array([np.nan, np.nan])
    model.write(sparse / "1")
    with pytest.raises(SourceError, match=f"image '{image.name}': an observation is not finite"):
        read_model(sparse / "1")


def test_a_name_of_two_images_is_told(sparse: Path) -> None:
    model = pycolmap.Reconstruction(sparse / "1")
    first, second = sorted(model.images)[:2]
    model.images[second].name = name = model.images[first].name
    model.write(sparse / "1")
    with pytest.raises(SourceError, match=f"two images have the name '{name}': rename one"):
        ColmapReader().open(sparse / "1")


def test_names_with_blanks_in_text_stay_whole(sparse: Path, tmp_path: Path) -> None:
    """COLMAP writes such names as they are, and reads them up to the blank."""
    model, text = pycolmap.Reconstruction(sparse / "1"), tmp_path / "text"
    for image_id, image in model.images.items():
        image.name = f"cam 1/image {image_id}.jpg"
    text.mkdir()
    model.write_text(text)
    names = [f"cam 1/image {image_id}.jpg" for image_id in sorted(model.images)]
    source = ColmapReader(edges="none").open(text)
    assert sorted(frame.frame_id for frame in source.frames) == names
    refined = hodge_pipeline.refine_colmap(text, out=tmp_path / "out", overrides=FREE)
    assert sorted(image.name for image in refined.models[0].images.values()) == names
    lines = (tmp_path / "out/sparse/0/images.txt").read_text().splitlines()
    assert sorted(line.split(maxsplit=9)[9] for line in lines if "jpg" in line) == names
    with pytest.raises(SourceError, match="names with blanks"):
        ColmapWriter(form="txt").write(tmp_path / "copy", source)


def contradict(model: Path) -> None:
    """Let the first entry of the first track name another observation of its image."""
    path = model / "points3D.bin"
    data = bytearray(path.read_bytes())
    at = 8 + 8 + 24 + 3 + 8 + 8  # count; id, xyz, colour, error, length of the track
    image, column = struct.unpack_from("<II", data, at)
    struct.pack_into("<II", data, at, image, column + 1)
    path.write_bytes(data)


def test_images_that_contradict_points_are_named_with_options_that_the_command_has(tmp_path: Path) -> None:
    synthetic(tmp_path)
    model = tmp_path / "binary"
    contradict(model)
    found = CliRunner().invoke(app, ["refine", "colmap", str(model), "--out", str(tmp_path / "out")])
    assert isinstance(found.exception, SourceError) and found.exception.exit_code == 1
    told = str(found.exception)
    assert "the track of point" in told and "model_converter" in told
    assert "tracks=false" not in told and "\n" not in told
    with pytest.raises(SourceError, match=NO_TRACKS):
        ColmapReader().open(model)
    assert len(ColmapReader(tracks=False).open(model).frames) == 8


def test_tracks_are_not_blamed_for_poses_that_cannot_be_read(tmp_path: Path) -> None:
    synthetic(tmp_path)
    path = tmp_path / "binary/images.bin"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(SourceError, match="images.bin") as refused:
        ColmapReader().open(tmp_path / "binary")
    assert NO_TRACKS not in str(refused.value)


def test_without_a_scale_nothing_is_in_metres(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the consistent solve, so that there are edges: on the page, in plots, in the table, at the terminal."""
    start, out, labels = disturbed(noisy(tmp_path), tmp_path / "start", 8.0, 0.15), tmp_path / "out", list[str]()
    monkeypatch.setattr("hodge_pipeline.refine.candidates._Candidates.is_settled", False)
    set_label = Axis.set_label_text
    monkeypatch.setattr(Axis, "set_label_text", lambda *a, **k: (labels.append(a[1]), set_label(*a, **k))[1])
    sets = [text for option in FREE for text in ("--set", option)]
    found = CliRunner().invoke(app, ["refine", "colmap", str(start), "--out", str(out), "--verbose", *sets])
    assert found.exit_code == 0, found.output
    page = re.sub(r"<[^>]*>", " ", (out / "report.html").read_text("utf-8"))
    for text in (found.output, page, *labels):
        assert not re.search(r"[\d,] ?(mm|cm|m)\b", text), text[:2000]
    assert "units" in found.output and any("residual" in label and "unit" in label for label in labels)
    with open(out / "edges.csv", newline="") as table:
        names = next(csv.reader(table))
    assert "residual_units" in names and not [name for name in names if name.endswith("_m")]
    edges, _ = read_edges(out / "edges.csv")
    assert len(edges.residual_m) and np.isfinite(edges.residual_m[edges.in_graph]).all()


def test_a_refined_model_finds_images_and_database_of_the_model_that_it_was_made_of(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(noisy(tmp_path / "project", database=True))
    for image in model.images.values():
        write_colour(tmp_path / "project/images" / image.name)
    out = tmp_path / "runs/refined"
    hodge_pipeline.refine_colmap(tmp_path / "project/model", out=out, overrides=FREE)
    source = ColmapReader().open(out)
    assert source.graph is not None and set(source.graph.source) == {"database"}
    assert all(frame.read_colour for frame in source.frames) and not any("not there" in note for note in source.notes)
    (out / "report.json").write_text("{")
    assert not any(frame.read_colour for frame in ColmapReader().open(out).frames), "the model is read all the same"


def test_an_input_that_is_off_everywhere_is_not_called_optimal(data_dir: Path, tmp_path: Path) -> None:
    model = disturbed(data_dir / "colmap/unsorted_tiny", tmp_path / "off", degrees=8.0, share=0.15)
    done = CliRunner().invoke(app, ["refine", "colmap", str(model), "--out", str(tmp_path / "out")])
    assert isinstance(done.exception, CheckError)
    assert done.stdout.startswith("verdict  in doubt, since 100% of the observations are more than 4 px off: kept")
