"""Small image sequences in each layout, made on the spot: 8x6 pixels, one metre and more of depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Camera, Floats, Frame

WIDTH, HEIGHT = 8, 6
INTRINSICS = "10 10 4 3 8 6\n"


def depth_values(seed: int = 0, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.random.default_rng(seed).integers(1000, 4000, shape).astype(np.uint16)


def write_depth(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", values)[1].tobytes())
    return path


def write_colour(
    path: Path, rgb: tuple[int, int, int] = (200, 100, 50), size: tuple[int, int] = (HEIGHT, WIDTH)
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((*size, 3), rgb[::-1], np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


def some_poses(count: int, seed: int = 0) -> Floats:
    return se3.exp(np.random.default_rng(seed).normal(0, 0.3, (count, 6)))


def pose_text(pose: Floats) -> str:
    return "".join("\t".join(f"{value:.7e}" for value in row) + "\t\r\n" for row in pose)


def seven_scenes_sequence(folder: Path, count: int = 3, colour: str = ".png") -> Path:
    for number, pose in enumerate(some_poses(count)):
        stem = folder / f"frame-{number:06d}"
        write_depth(stem.with_name(f"{stem.name}.depth.png"), depth_values(number))
        write_colour(stem.with_name(f"{stem.name}.color{colour}"))
        stem.with_name(f"{stem.name}.pose.txt").write_text(pose_text(pose), newline="")
    (folder / "camera-intrinsics.txt").write_text(INTRINSICS)
    return folder


def tum_line(stamp_s: float, pose: Floats) -> str:
    numbers = [*pose[:3, 3], *se3.to_quat_xyzw(pose)]
    return f"{stamp_s:.6f} " + " ".join(f"{number:.9f}" for number in numbers) + "\n"


def tum_folder(folder: Path, stamps_s: tuple[float, ...] = (10.0, 10.5, 11.25), colour_delay_s: float = 0.01) -> Path:
    for row, stamp_s in enumerate(stamps_s):
        write_depth(folder / f"depth/{stamp_s:.6f}.png", depth_values(row))
        write_colour(folder / f"rgb/{stamp_s + colour_delay_s:.6f}.png")
    lines = [f"{stamp_s:.6f} depth/{stamp_s:.6f}.png\n" for stamp_s in stamps_s]
    (folder / "depth.txt").write_text("# depth maps\n" + "".join(lines))
    stamps_s = tuple(stamp_s + colour_delay_s for stamp_s in stamps_s)
    (folder / "rgb.txt").write_text("# colour\n" + "".join(f"{s:.6f} rgb/{s:.6f}.png\n" for s in stamps_s))
    (folder / "intrinsics.txt").write_text("# fx fy cx cy width height\n" + INTRINSICS)
    return folder


def points_in_cam(depth: np.ndarray, camera: Camera, step: int) -> Floats:
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    z = depth[::step, ::step].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    return points[z > 0]


def agreement(target: Frame, source: Frame, target_from_source: Floats, step: int = 8) -> float:
    """The share of the source's points that fall on the target's depth image within 5 cm of the surface there."""
    assert target.read_depth and source.read_depth and target.camera and source.camera
    camera, seen = target.camera, target.read_depth()
    points = se3.transform(target_from_source, points_in_cam(source.read_depth(), source.camera, step))
    ahead = points[points[:, 2] > 0.1]
    u = np.round(camera.fx * ahead[:, 0] / ahead[:, 2] + camera.cx).astype(int)
    v = np.round(camera.fy * ahead[:, 1] / ahead[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    gap = np.abs(seen[v[inside], u[inside]] - ahead[inside, 2])
    return float((gap < 0.05).sum() / len(points))


def linked(folder: Path, into: Path) -> Path:
    """The folder `into`, which holds links to all that `folder` holds: the same under another name."""
    for entry in folder.iterdir():
        (into / entry.name).symlink_to(entry)
    return into
