"""Images that are paired by the numbers in their names, and the poses that lie beside them: Redwood's layout, and those
of Replica, ScanNet and Stray Scanner.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from hodge_adapters.association import unpaired_doubts
from hodge_adapters.seven_scenes.files import FrameFiles, placeholders, read_poses, told_lost
from hodge_adapters.text_rows import listed, names_in, read_rows, read_text, to_floats
from hodge_adapters.trajectories.log import read_log_file
from hodge_adapters.tum.image_lists import StampedImages, find_colour_folder, stamped_images
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.text import counted

LAYOUT = "put depth (PNG of 16 bits) in depth/ and colour in color/, both named by one number, 00000.png, …"
OTHER_IMAGES = (".pgm", ".tif", ".tiff", ".exr")
TUM_FILES = ("depth.txt", "rgb.txt", "groundtruth.txt")
REPLICA_IMAGES = "results"
LOG_FILES = ("trajectory.log", "scene/trajectory.log", "test_scene/trajectory.log")
TRUE_FILES = ("traj.txt", "traj_w_c.txt")
"""Of Replica as NICE-SLAM and vMAP render it: sixteen numbers a frame, the 4x4 matrix by rows, camera to world."""
STRAY_FILE, STRAY_VIDEO = "odometry.csv", "rgb.mp4"
"""Of Stray Scanner, by the phone's own tracking: stamp, frame, x y z, qx qy qz qw."""
_NUMBER = re.compile(r"(?<!\d)\d{1,18}(?!\d)")
_IMAGES = (".png", ".jpg", ".jpeg")
_KINDS = {"depth": re.compile("depth", re.IGNORECASE), "colour": re.compile("frame|rgb|colou?r|image", re.IGNORECASE)}
"""What the names of images say, where one folder holds both kinds."""


def find_images(folder: Path) -> tuple[Path, Path] | None:
    """The folders of the depth and of the colour images, None where it has a list or truth of a TUM sequence, or no
    such images. One folder for both is Replica's `results`, or the folder itself.
    """
    if any((folder / name).is_file() for name in TUM_FILES):
        return None
    colour = find_colour_folder(folder)
    if colour is not None and (folder / "depth").is_dir():
        return folder / "depth", colour
    both = folder / REPLICA_IMAGES if (folder / REPLICA_IMAGES).is_dir() else folder
    kinds = Counter(map(_kind, names_in(both))) if both.is_dir() else Counter[str]()
    fewer, more = sorted((kinds["depth"], kinds["colour"]))
    return (both, both) if fewer > 1 and 2 * fewer > more else None


def _advice(folder: Path) -> str:
    other = next((name for name in names_in(folder) if Path(name).suffix.lower() in OTHER_IMAGES), None)
    return LAYOUT if other is None else f"convert {other} and its like to PNG, depth with all 16 bits"


def list_images(folder: Path, notes: list[str]) -> StampedImages:
    """The images of a folder by the number in their names, their stamp; depth without colour is noted."""
    if stamped_images(folder / "depth"):
        raise SourceError(
            f"{folder / 'depth'}: its images are named by their stamps: read them with the reader tum (hodge run tum), "
            "and set source.reader.depth_scale=1000 if depth is in millimetres"
        )
    depth_folder, colour_folder = find_images(folder) or (folder / "depth", None)
    mixed = depth_folder == colour_folder
    depth = _by_number(depth_folder, notes, "depth" if mixed else "")
    if not depth:
        raise SourceError(f"{depth_folder}: no PNG in it: {_advice(depth_folder)}")
    colour = _by_number(colour_folder, notes, "colour" if mixed else "") if colour_folder else {}
    numbers = sorted(depth)
    alone = [number for number in numbers if number not in colour]
    if alone:
        notes.append(f"{counted(len(alone), 'frame has|frames have')} no colour image: {listed(alone)}")
    doubts = unpaired_doubts([number in colour for number in numbers]) if colour else ()
    none_s, one_run = np.zeros(len(numbers)), np.zeros(len(numbers), np.int64)
    stamps_s = np.array(numbers, float)
    images = [depth[number] for number in numbers], [colour.get(number) for number in numbers]
    return StampedImages(stamps_s, *images, none_s, (), one_run, doubts)


def _kind(name: str) -> str:
    """`depth` or `colour`, by the name of an image; empty for other files."""
    is_image = name.lower().endswith(_IMAGES)
    return next((kind for kind, pattern in _KINDS.items() if is_image and pattern.search(name)), "")


def _by_number(folder: Path, notes: list[str], kind: str) -> dict[int, Path]:
    """The images of a folder, or those of one kind, by the first of the numbers in their names that tells most of them
    apart, so that `d435_0001.png` is 1. Raises `SourceError` where most have none of their own.
    """
    names = [name for name in names_in(folder) if name.lower().endswith(_IMAGES) and kind in ("", _kind(name))]
    numbers = [[int(digits) for digits in _NUMBER.findall(Path(name).stem)] for name in names]
    places = range(max(map(len, numbers), default=0))
    place = max(places, key=lambda place: len({each[place] for each in numbers if place < len(each)}), default=0)
    found: dict[int, Path] = {}
    skipped: list[str] = []
    for name, each in zip(names, numbers, strict=True):
        if place >= len(each) or each[place] in found:
            skipped.append(name)
        else:
            found[each[place]] = folder / name
    if len(skipped) > len(found):
        raise SourceError(
            f"{folder}: {len(skipped)} of {len(names)} images have no number of their own ({listed(skipped)}), by "
            f"which depth and colour are paired: {LAYOUT}"
        )
    if skipped:
        left_out = counted(len(skipped), "image")
        notes.append(f"{folder.name}: {left_out} without an own number left out: {listed(skipped)}")
    return found


def phone_advice(path: Path) -> str:
    """What to do with a recording of a phone that is not read as it is; empty for anything else."""
    if path.suffix.lower() == ".r3d" or (path / "rgbd").is_dir() and (path / "metadata").is_file():
        return f"Record3D's depth is packed (LZFSE), which is not read: unpack it (Python: pyliblzfse), then {LAYOUT}"
    if (path / STRAY_VIDEO).is_file() and (path / "depth").is_dir():
        return (
            f"Stray Scanner's colour is a video: take it apart in this folder, `mkdir color && ffmpeg -i {STRAY_VIDEO} "
            "-start_number 0 color/%06d.jpg`, then give the folder again"
        )
    return ""


def true_poses(path: Path, numbers: list[int], notes: list[str]) -> tuple[Floats, Path] | None:
    """Poses (N, 4, 4) of these frames by `traj.txt`, whose row is the frame's number, NaN where there is none,
    and its path; None without such a file.
    """
    file = next((path / name for name in TRUE_FILES if (path / name).is_file()), None)
    if file is None:
        return None
    values = to_floats(read_text(file).split())
    if not values or len(values) % 16:
        raise SourceError(f"{file}: not sixteen numbers for each frame, a 4x4 matrix by rows: mend or remove it")
    rows = np.reshape(values, (-1, 4, 4))
    lost = placeholders(rows)
    rows = np.where((se3.is_motion(rows) & ~lost)[:, None, None], rows, np.nan)
    poses = _at(dict(enumerate(rows)), numbers)
    notes.append(f"the truth is {file.name}'s")
    notes.extend([told_lost(np.flatnonzero(lost).tolist())] if lost.any() else [])
    without = int(np.isnan(poses[:, 0, 0]).sum())
    if without:
        notes.append(f"{without} of {len(poses)} frames have no truth in it")
    return poses, file


def estimated_poses(path: Path, numbers: list[int], notes: list[str]) -> tuple[Floats, Path | None]:
    """Poses (N, 4, 4) of these frames by another program, NaN where there is none: Redwood's `trajectory.log`, Stray
    Scanner's `odometry.csv`, or ScanNet's `pose/0.txt`, …; and the path of the file, if there is one.
    """
    log = next((path / name for name in LOG_FILES if (path / name).is_file()), None)
    stray, folder = path / STRAY_FILE, path / "pose"
    file = log or (stray if stray.is_file() else None)
    if file is None and not folder.is_dir():
        return np.full((len(numbers), 4, 4), np.nan), None
    notes.append(f"poses from {(file or folder).relative_to(path)}: an estimate of another program, not the truth")
    if file is None:
        files = [FrameFiles(folder.name, number, 0, {"pose": folder / f"{number}.txt"}) for number in numbers]
        return read_poses(files, notes), None
    poses = _at(read_log_file(log).poses if log else _stray_poses(stray), numbers)
    without = int(np.isnan(poses[:, 0, 0]).sum())
    if without:
        notes.append(f"{without} of {len(poses)} frames have no pose in it")
    return poses, file


def _stray_poses(file: Path) -> dict[int, Floats]:
    """Poses by the number of the frame; rows that are none, as the head, give none."""
    rows = [row for row in (to_floats(row.fields[:9]) for row in read_rows(file)) if row and len(row) == 9]
    usable = [row for row in rows if np.isfinite(row).all() and np.linalg.norm(row[5:9]) > 0]
    return {int(row[1]): se3.from_quat_xyzw(np.array(row[2:5]), np.array(row[5:9])) for row in usable}


def _at(poses: dict[int, Floats], numbers: list[int]) -> Floats:
    return np.array([poses.get(number, np.full((4, 4), np.nan)) for number in numbers])
