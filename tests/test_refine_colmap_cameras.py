"""What `refine_colmap` says of calibrations that tracks contradict, and of the scale that depth tells."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, disturbed, noisy, synthetic
from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.points import with_points
from hodge_adapters.colmap.records import NO_POINT, Model
from hodge_adapters.colmap.scale import other_camera_note, seen_depths
from hodge_adapters.images import pixels
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.refine.scale import metric_scale
from hodge_pipeline.types import Floats


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


def sensor_depth(model: Model, row: int, factor: float, seed: int) -> Floats:
    """Metres of an image: chance but where its points are seen through so many times its focal length."""
    image, record = model.images[row], model.cameras[model.images[row].camera_id]
    out = np.random.default_rng([seed, row]).uniform(1.0, 9.0, (record.height, record.width))
    camera, seen = colmap_camera(record), image.point_ids != NO_POINT
    focal = factor * np.array([camera.focal_length_x, camera.focal_length_y])
    rays = np.asarray(camera.cam_from_img(image.pixels[seen]))
    columns, rows = np.floor(rays * focal + [camera.principal_point_x, camera.principal_point_y]).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < record.width) & (rows < record.height)
    xyz = model.points.xyz[model.points.rows_of(image.point_ids[seen])]
    out[rows[inside], columns[inside]] = 2.0 * se3.transform(se3.inverse(image.world_from_cam), xyz)[inside, 2]
    return out


def test_depth_of_another_camera_is_told_by_many_points_and_each_image_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synthetic(tmp_path)
    model, read = read_model(tmp_path / "binary")[1], list[int]()
    sensors, few = {row: Path(str(row)) for row in range(8)}, np.arange(len(model.points.ids)) < 12

    def told(model: Model, factor: float, seed: int) -> str:
        def depth(path: Path, **_: object) -> Floats:
            read.append(int(path.name))
            return sensor_depth(model, read[-1], factor, seed)

        monkeypatch.setattr(pixels, "read_depth", depth)
        return other_camera_note(model, sensors, 1000.0, ()) or ""

    assert told(model, 1.0, 0) == "" and read == list(range(8))
    assert "with a focal length 1.1 times theirs: give --depth-camera" in told(model, 1.1, 0)
    assert not any(told(with_points(model, few), 9.0, seed) for seed in range(8)), "by chance some fit well"


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


def test_a_principal_point_that_tracks_contradict_is_a_doubt(tmp_path: Path) -> None:
    """Poses turn to make up for it, and free focal lengths explain little of what is left."""
    model = pycolmap.Reconstruction(noisy(tmp_path))
    for camera in model.cameras.values():
        camera.params = camera.params + np.array([0.0, 40.0, -30.0, 0.0])
    (result,) = hodge_pipeline.refine_colmap(model, database="none", overrides=FREE).results
    assert "principal points moved by" in result.decision.doubt and result.decision.doubt.endswith("--refine all")


def test_calibrations_of_an_exact_model_are_not_in_doubt(tmp_path: Path) -> None:
    """Freed, they gained half of 8e-8 px."""
    synthetic(tmp_path)
    off = disturbed(tmp_path / "text", tmp_path / "off")
    (result,) = hodge_pipeline.refine_colmap(off, database="none", overrides=FREE).results
    assert result.decision.outcome == "refined" and result.decision.doubt == ""


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
