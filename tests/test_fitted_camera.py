"""The focal length that images tell, and what is said of a camera that is only assumed."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.images import fitted_camera
from hodge_adapters.images.camera_files import Intrinsics
from hodge_adapters.images.fitted_camera import CameraFit
from hodge_adapters.tum import reader
from hodge_adapters.tum.reader import CAMERAS, TumReader
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.types.notes import Rank
from readers_data import linked

FOCAL_PX, FRAMES = 525.0, 14


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of 640x480 and 525 pixels of focal length, rendered at half of that."""
    options = DemoOptions(frames=FRAMES, width=320, height=240, stride=2, turns=0.1)
    folder = make_sequence(tmp_path_factory.mktemp("fitted") / "film", options)
    for kind, between in (("depth", cv2.INTER_NEAREST), ("rgb", cv2.INTER_LINEAR)):
        for file in (folder / kind).iterdir():
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), cv2.resize(image, (640, 480), interpolation=between))
    return folder


@pytest.fixture(scope="module")
def office(film: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The film in Redwood's layout."""
    folder = tmp_path_factory.mktemp("office")
    for kind in ("depth", "rgb"):
        (folder / kind).mkdir()
        for number, file in enumerate(sorted((film / kind).iterdir())):
            shutil.copy(file, folder / kind / f"{number}{file.suffix}")
    return folder


def test_the_focal_length_is_told_whatever_the_unit_of_depth(office: Path, tmp_path: Path) -> None:
    source = IclNuimReader(camera=(1.0, 1.0, 1.0, 1.0)).open(office)
    depth, colour = source.files[:FRAMES], source.files[FRAMES:]
    stamps_s = np.arange(FRAMES) / 10
    told = fitted_camera.focal_px((640, 480), depth, colour, stamps_s, 6000.0)  # of 5000
    assert told == pytest.approx(FOCAL_PX, rel=0.05)
    rng, image, at_rest = np.random.default_rng(0), cv2.imread(str(colour[0])).astype(float), []
    for number in range(FRAMES):
        at_rest.append(tmp_path / f"{number}.png")
        cv2.imwrite(str(at_rest[-1]), np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8))
    assert fitted_camera.focal_px((640, 480), depth[:1] * FRAMES, at_rest, stamps_s, 5000.0) is None


def test_an_assumed_camera_that_images_contradict_is_told(office: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = IclNuimReader(depth_scale=5000.0)
    source = options.open(office)
    assert source.doubts == () and any("Redwood's intrinsics taken" in note for note in source.notes)
    monkeypatch.setattr("hodge_adapters.icl_nuim.reader.REDWOOD", Intrinsics(400.0, 400.0, 319.5, 239.5, (640, 480)))
    (doubt,) = (each for each in inspect(office, options)["oddities"] if "is assumed" in each)
    assert "focal length 400 is assumed" in doubt and ",319.5,239.5]" in doubt
    assert IclNuimReader(depth_scale=5000.0, camera=(400.0, 400.0, 319.5, 239.5)).open(office).doubts == ()


def test_images_of_another_shape_are_refused_with_what_they_tell(office: Path, tmp_path: Path) -> None:
    for kind in ("depth", "rgb"):
        (tmp_path / kind).mkdir()
        for file in (office / kind).iterdir():
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(tmp_path / kind / f"{file.stem}.png"), image[60:420])
    with pytest.raises(
        SourceError, match=r"images of 640x360, .* a focal length of about 5\d\d pixels .*319.5,179.5\]"
    ):
        IclNuimReader(depth_scale=5000.0).open(tmp_path)


def test_errors_count_in_each_camera_s_own_pixels(office: Path) -> None:
    """A longer focal length makes every error a smaller slope: it does not fit better for that."""
    source = IclNuimReader(camera=(1.0, 1.0, 1.0, 1.0)).open(office)
    longer = {name: Intrinsics(f, f, 319.5, 239.5, (640, 480)) for name, f in (("own", 525.0), ("longer", 640.0))}
    found = fitted_camera.fitting(
        longer, "own", source.files[:FRAMES], source.files[FRAMES:], np.arange(FRAMES) / 10, 5000.0
    )
    assert found == {}


def test_a_camera_counts_as_told_only_if_it_fits_better_in_nearly_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mean that is surely better may be so by what all pairs share."""
    errors = np.tile([0.0, -0.5, -0.52, -0.3], (20, 1))  # standard, rival, best, worse
    errors[:5, 1] = -0.53
    monkeypatch.setattr(fitted_camera, "_errors", lambda *_: errors)
    cameras = dict.fromkeys(("standard", "rival", "best", "worse"), Intrinsics(525.0, 525.0, 319.5, 239.5, (640, 480)))
    found = fitted_camera.fitting(cameras, "standard", (), (), np.zeros(0), 5000.0)
    assert {name: fit.beaten for name, fit in found.items()} == {"best": 0.0, "rival": 0.75, "worse": 1.0}
    (doubt,) = fitted_camera.untold_camera_doubts(found)
    assert doubt.rank is Rank.INPUT and str(doubt) == (
        "the camera may be rival in place of best: set source.reader.camera=rival if it was; best fits better in "
        "only 75 % of the pairs of frames"
    )
    assert fitted_camera.untold_camera_doubts({"best": CameraFit(0.4), "worse": CameraFit(0.3, 1.0)}) == ()


def test_the_day_of_the_stamps_counts_more_than_the_images(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "fitting", lambda *_: {"fr2": CameraFit(0.02), "fr3": CameraFit(0.02, 0.5)})
    source = TumReader().open(linked(data_dir / "tum/fr1_rpy_part", tmp_path))
    assert source.frames[0].camera.fx == CAMERAS["fr1"].fx
    assert "intrinsics of fr1 taken: by the day of the stamps, 2011-05-10" in source.notes


def test_a_camera_without_distortion_is_not_taken_for_another(film: Path) -> None:
    (film / "intrinsics.txt").unlink()
    source = TumReader().open(film)
    assert source.frames[0].camera.fx == FOCAL_PX
    assert any("whose cameras fit no better" in note for note in source.notes)
