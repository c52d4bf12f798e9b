"""COLMAP models for tests: synthetic, noisy, disturbed, thinned, and what is compared of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from hodge_pipeline import se3

NOISE_PX = 0.3
FREE = ("executor.workers=0",)


def synthetic(
    folder: Path, model: str = "SIMPLE_RADIAL", database: bool = False, cameras_per_rig: int = 2
) -> pycolmap.Reconstruction:
    """A rig model with exact observations, written by pycolmap as text and binary."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, cameras_per_rig, 4
    options.num_points3D = 120
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = pycolmap.Camera.create_from_model_name(1, model, 1280.0, 1024, 768).params
    for name in ("text", "binary"):
        (folder / name).mkdir(parents=True)
    base = pycolmap.Database.open(folder / "database.db") if database else None
    pycolmap.set_random_seed(0)
    made = pycolmap.synthesize_dataset(options, base) if base else pycolmap.synthesize_dataset(options)
    if base:
        base.close()
    made.write_text(folder / "text")
    made.write_binary(folder / "binary")
    return made


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
