"""A COLMAP model placed in the world of known positions: GPS and gravity of its database, or a table."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, noisy
from hodge_adapters.colmap.bodies import bodies_of
from hodge_adapters.colmap.content import content_of
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.priors import database_priors
from hodge_adapters.colmap.resection import resected
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats

WORLD_FROM_MODEL = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(se3.so3_exp(np.array([0.3, -1.0, 0.5]))), np.array([10.0, 20.0, 3.0])
)
ZURICH = (47.3769, 8.5417, 408.0)


def street(folder: Path, *, noise_px: float = 0.3, sight: float = 0.9) -> Path:
    """Sixteen images in a row that share points with their neighbours alone, at the optimum of their keypoints."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=1000, height=750, params=[800.0, 500, 375])
    )
    true = [se3.from_parts(np.eye(3), np.array([0.5 * row, 0.2 * np.sin(row), 0.0])) for row in range(16)]
    points = rng.uniform([-1, -1.5, 3], [9, 1.5, 5], (900, 3))
    pixels = []
    for pose in true:
        at = se3.transform(se3.inverse(pose), points)
        pixels.append(800 * at[:, :2] / at[:, 2:] + [500, 375] + noise_px * rng.normal(size=(900, 2)))
    seen = np.array([np.abs(points[:, 0] - pose[0, 3]) < sight for pose in true])
    for row, pose in enumerate(true):
        image = pycolmap.Image(f"{row:02d}.jpg", pixels[row][seen[row]], 1, row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(se3.inverse(pose)[:3]))
    for number, xyz in enumerate(points):
        track = pycolmap.Track()
        for row in np.flatnonzero(seen[:, number]):
            track.add_element(int(row) + 1, int(seen[row, :number].sum()))
        if track.length() > 1:
            model.add_point3D(xyz, track)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    folder.mkdir()
    model.write(folder)
    return folder


def world(model: Path) -> dict[str, Floats]:
    """Where each image is in the world, metres."""
    images = pycolmap.Reconstruction(model).images.values()
    return {image.name: WORLD_FROM_MODEL * image.projection_center() for image in images}


def database(path: Path, positions: dict[str, Floats], *, geodetic: bool, gravity: Floats | None = None) -> Path:
    """A database with pose priors alone."""
    made = pycolmap.Database.open(path)
    camera = made.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 800.0, 1000, 750))
    for number, (name, position) in enumerate(sorted(positions.items()), 1):
        made.write_image(pycolmap.Image(name, np.zeros((0, 2)), camera, number), True)
        prior = pycolmap.PosePrior()
        if geodetic:
            position = pycolmap.GPSTransform().enu_to_ellipsoid(position[None], *ZURICH)[0]
        prior.position = position
        prior.coordinate_system = getattr(pycolmap.PosePriorCoordinateSystem, "WGS84" if geodetic else "CARTESIAN")
        prior.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), number)
        if gravity is not None:
            prior.gravity = gravity
        made.write_pose_prior(prior)
    made.close()
    return path


def table(path: Path, positions: dict[str, Floats]) -> Path:
    rows = [f"{name},{e:.9f},{n:.9f},{u:.9f},0.05" for name, (e, n, u) in positions.items()]
    path.write_text("\n".join(["name,e,n,u,sigma", *rows]) + "\n")
    return path


def off_m(model: pycolmap.Reconstruction, positions: dict[str, Floats]) -> float:
    return float(
        max(np.linalg.norm(image.projection_center() - positions[image.name]) for image in model.images.values())
    )


@pytest.mark.parametrize("kind", ["table", "cartesian", "geodetic"])
def test_the_result_is_in_the_world_of_known_positions(tmp_path: Path, kind: str) -> None:
    model = street(tmp_path / "model")
    positions = world(model)
    if kind == "table":
        options = [f"model.positions={table(tmp_path / 'gps.csv', positions)}", "model.database=none"]
    else:
        options = ["model.positions=database"]
        database(tmp_path / "database.db", positions, geodetic=kind == "geodetic")
        if kind == "geodetic":  # east, north, up of the plane at the first image
            first = positions["00.jpg"]
            positions = {name: point - first for name, point in positions.items()}
    (result,) = hodge_pipeline.refine_colmap(model, overrides=(*FREE, "model.position_sigma_m=0.05", *options)).results
    assert result.decision.outcome == "refined" and "in the world of 16 known positions" in result.decision.reason
    assert off_m(result.model.native, positions) < 0.05
    assert result.decision.change is None or result.decision.change.is_metric


def test_known_positions_mend_drift_and_a_gross_one_moves_nothing(tmp_path: Path) -> None:
    true = world(street(tmp_path / "true", noise_px=0.0))
    drifted = street(tmp_path / "drifted", noise_px=1.5, sight=0.6)
    given = {**true, "07.jpg": true["07.jpg"] + 40.0}
    options = (*FREE, f"model.positions={table(tmp_path / 'gps.csv', given)}", "model.database=none")
    (result,) = hodge_pipeline.refine_colmap(drifted, overrides=options).results
    start = {image.name: image.projection_center() for image in result.start.native.images.values()}
    found = {image.name: image.projection_center() for image in result.model.native.images.values()}
    before, after = (np.array([np.linalg.norm(one[name] - true[name]) for name in true]) for one in (start, found))
    assert "15 known positions (1 do not agree)" in result.decision.reason
    assert np.median(after) < 0.5 * np.median(before) and after.max() < 0.3, (before, after)


def test_gravity_alone_turns_the_model_upright(tmp_path: Path) -> None:
    model = street(tmp_path / "model")
    nowhere = {name: np.full(3, np.nan) for name in world(model)}
    database(tmp_path / "database.db", nowhere, geodetic=False, gravity=np.array([0.0, 1.0, 0.0]))
    options = (*FREE, "model.positions=database")
    (result,) = hodge_pipeline.refine_colmap(model, overrides=options).results
    assert "upright by gravity of 16 images" in result.decision.reason
    down = [image.cam_from_world().inverse().rotation.matrix()[:, 1] for image in result.model.native.images.values()]
    np.testing.assert_allclose(down, np.tile([0, 0, -1.0], (16, 1)), atol=0.02)


def test_what_a_database_knows_is_said_and_used_only_when_asked_for(tmp_path: Path) -> None:
    model = street(tmp_path / "model")
    database(tmp_path / "database.db", world(model), geodetic=True)
    (opened,) = ColmapModels().open_models(model)
    assert any("16 images: --positions database" in note for note in opened.notes)
    assert not opened.placed().placing and len(database_priors(tmp_path / "database.db")) == 16


def test_priors_of_databases_before_colmap_4(tmp_path: Path) -> None:
    path = database(tmp_path / "database.db", {"a.jpg": np.array([1.0, 2.0, 3.0])}, geodetic=False)
    with sqlite3.connect(path) as opened:
        ((position, system),) = opened.execute("SELECT position, coordinate_system FROM pose_priors")
        opened.execute("DROP TABLE pose_priors")
        opened.execute("CREATE TABLE pose_priors (image_id INTEGER, position BLOB, coordinate_system INTEGER)")
        opened.execute("INSERT INTO pose_priors VALUES (1, ?, ?)", (position, system))
    known = database_priors(path)["a.jpg"]
    np.testing.assert_array_equal(known.position, [1, 2, 3])
    assert np.isnan(known.covariance).all() and np.isnan(known.gravity).all()


def test_positions_that_do_not_tell_leave_the_model_where_it_is(tmp_path: Path) -> None:
    model = street(tmp_path / "model")
    positions = world(model)
    on_a_line = {name: np.array([row, 0.0, 0.0]) for row, name in enumerate(sorted(positions))}
    rng = np.random.default_rng(1)
    random = {name: 100 * rng.normal(size=3) for name in positions}
    for given, said in (
        (on_a_line, "on one line"),
        (random, "less than half"),
        ({"00.jpg": np.zeros(3)}, "3 are needed"),
    ):
        reader = ColmapModels(positions=str(table(tmp_path / "gps.csv", given)), database="none")
        placed = reader.open_models(model)[0].placed()
        assert not placed.placing and any(said in note for note in placed.notes)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a,b\n1,2\n", "gps.csv:1: .*e,n,u"),
        ("name,e,n,u\n00.jpg,1,x,2\n", "gps.csv:2: n is 'x'"),
        ("stamp,e,n,u\n1.5,1,2,3\n", "no column of names"),
    ],
)
def test_tables_that_are_none_are_named(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "gps.csv").write_text(text)
    with pytest.raises(SourceError, match=complaint):
        ColmapModels(positions=str(tmp_path / "gps.csv"), database="none").open_models(street(tmp_path / "model"))


def test_a_rig_is_placed_by_its_points_far_from_the_origin_too(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(noisy(tmp_path))
    positions = []
    for far_m in (0.0, 1e6):
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([far_m, -far_m, 0.0])))
        records = content_of(model)
        bodies = bodies_of(model, [image.image_id for image in records.images])
        moved = resected(records, bodies)[:, :3, 3] - bodies.world_from_body[:, :3, 3]
        assert moved.any(), "where RANSAC finds nothing, poses stay"
        positions.append(moved)
    np.testing.assert_allclose(positions[1], positions[0], atol=1e-6)
