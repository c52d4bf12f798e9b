"""COLMAP models through pycolmap: files read after a check, what pycolmap refuses with a reason, content as arrays."""

from __future__ import annotations

import re
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from hodge_adapters.colmap.binary import content_arrays
from hodge_adapters.colmap.check import REMEDY, check_files, check_words, names_with_blanks
from hodge_adapters.colmap.files import MODEL_FILES, model_ending
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import NO_POINT, CameraRecord, ImageRecord, Model, matrix_of
from hodge_adapters.posed import length_notes
from hodge_adapters.text_rows import natural
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.text import counted

MOST_PIXELS = 1 << 16
"""Across an image: wider ones are no photographs, and buffers of that size would be asked for."""
OFF_UNIT = 1e-6
"""How far from 1 the length of a quaternion may be: pycolmap takes those of a model without rigs as they are."""
REFUSALS = (
    (
        r"point2D\.point3D_id == point3D_id \((\d+) vs\. (\d+)\)",
        "the track of point {1} names what point {0} was seen at",
    ),
    (r"__n \(which is (\d+)\)", "the track of a point names observation {0} of an image that has fewer"),
    (r"Image with ID (-?\d+) does not", "the track of a point, or a frame, names image {0}, which is not there"),
    (r"as image (\d+) in frame (\d+) does not exist", "frame {1} names image {0}, which is not there"),
    (r"rigs_\.emplace", "a rig is given twice"),
    (r"Sensor \((\w+, \d+)\) is inserted twice", "a rig has a sensor twice ({0})"),
    (r"Rig with ID (\d+) does not exist", "a frame is of rig {0}, which is not there"),
    (r"HasSensor", "a frame has an image of a camera which its rig has not"),
    (r"Camera (?:with ID )?(\d+) .*(?:not found|does not exist)", "camera {0} is used, which is not there"),
    (r"image_to_frame|\.cc:463\]", "an image is in two frames"),
    (r"images_\.emplace|image_ids", "an image is given twice"),
    (r"points3D_\.emplace", "a point is given twice"),
    (r"HasDataId|unordered_map::at", "an image is in no frame, or of a camera that is not there"),
)
"""What pycolmap says of files that contradict each other, and what that means."""


def read_model(folder: Path, tracks: bool = True) -> tuple[pycolmap.Reconstruction, Model]:
    """The model of a folder, and its content.

    Without `tracks` neither points nor what saw them. Raises `SourceError` with the file, or what contradicts what.
    """
    ending = model_ending(folder) or ".bin"
    rigs = _rig_files(folder, ending)
    paths = [folder / f"{name}{ending}" for name in MODEL_FILES[:3]]
    has_points = tracks and paths[2].is_file()
    files = (*(paths if has_points else paths[:2]), *rigs)
    check_files(files)
    try:
        model = read_reconstruction(folder) if has_points else _without_points(files, ending)
    except SourceError:
        if ending == ".txt":
            check_words(files)
        raise
    content = checked_content(model, folder, has_points)
    several = sum(rig.num_sensors() > 1 for rig in model.rigs.values())
    told = (
        f"{several} of {len(model.rigs)} rigs have more than one sensor: {counted(len(model.frames), 'frame')} of rigs"
    )
    return model, replace(content, files=files, notes=(*([told] if several else []), *content.notes))


def read_reconstruction(folder: Path) -> pycolmap.Reconstruction:
    """The model of a folder whose files have the right sizes. Raises `SourceError` with a reason."""
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises what its C++ checks raise: RuntimeError, ValueError, IndexError
        raise SourceError(f"{folder}: {_reason(str(error) or type(error).__name__)}: {REMEDY}") from error
    for image_id, name in names_with_blanks(folder / "images.txt").items() if model_ending(folder) == ".txt" else ():
        model.images[image_id].name = name
    return model


def content_of(reconstruction: pycolmap.Reconstruction, tracks: bool = True) -> Model:
    """The posed images in natural order of their names, their cameras, and the points with their tracks."""
    posed = sorted(
        (reconstruction.images[image_id] for image_id in reconstruction.reg_image_ids()),
        key=lambda image: natural(image.name),
    )
    poses = [_pose(image) for image in posed]
    seen, points = content_arrays(reconstruction)
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = [
        ImageRecord(one.image_id, pose, one.camera_id, one.name, *(seen[one.image_id] if tracks else nothing))
        for one, pose in zip(posed, poses, strict=True)
    ]
    cameras = {
        key: CameraRecord(key, camera.model.name, camera.width, camera.height, tuple(camera.params))
        for key, camera in reconstruction.cameras.items()
    }
    # what an image without a pose saw tells nothing
    posed_entries = np.isin(points.image_ids, [image.image_id for image in images])
    return Model(cameras, images, points if posed_entries.all() else points.seen_by(posed_entries))


def checked_content(reconstruction: pycolmap.Reconstruction, where: Path, tracks: bool = True) -> Model:
    """The content, if its numbers can be a model's; points that are not finite are taken out of the model, quaternions
    of another length than 1 divided by it, and both noted.

    Raises `SourceError`.
    """
    notes = _normalise(reconstruction)
    try:
        content = content_of(reconstruction, tracks)
        lost = content.points.ids[~np.isfinite(content.points.xyz).all(axis=1)].tolist()
        for key in lost:
            reconstruction.delete_point3D(key)
        content = content_of(reconstruction, tracks) if lost else content
    except UnicodeDecodeError as error:
        raise SourceError(f"{where}: the name of an image is no UTF-8: {REMEDY}") from error
    except OverflowError as error:
        raise SourceError(f"{where}: the id of a point is beyond 2^63: {REMEDY}") from error
    except (ValueError, IndexError) as error:
        raise SourceError(f"{where}: {_reason(str(error))}: {REMEDY}") from error
    except RuntimeError as error:
        raise SourceError(f"{where}: an image is of a sensor whose place on its rig is not known: {REMEDY}") from error
    _check(content, where)
    for image in content.images:
        length = float(np.linalg.norm(reconstruction.images[image.image_id].cam_from_world().rotation.quat))
        if not abs(length - 1.0) < OFF_UNIT or not se3.is_motion(image.world_from_cam):
            is_other = np.isfinite(length) and abs(length - 1.0) >= OFF_UNIT
            why = f"is of length {length:.7g}, not 1" if is_other else f"or position is none or past {se3.MAX_NUMBER:g}"
            raise SourceError(f"{where}: image {image.name!r}: its quaternion {why}: mend it, or register it again")
    notes += [f"{counted(len(lost), 'point')} not finite: left out"] if lost else []
    return replace(content, notes=tuple(notes))


def _normalise(reconstruction: pycolmap.Reconstruction) -> list[str]:
    """A note where poses have quaternions of other lengths than 1, such as rounded ones: they are divided by theirs,
    since bundle adjustment takes them for rotations as they are.
    """
    frames = [frame for frame in reconstruction.frames.values() if frame.has_pose()]
    quats = np.array([frame.rig_from_world.rotation.quat for frame in frames]).reshape(-1, 4)
    lengths = np.linalg.norm(quats, axis=1)
    good = (lengths > 1 / se3.MAX_NUMBER) & (lengths < se3.MAX_NUMBER)
    for row in np.flatnonzero(good & (np.abs(lengths - 1) >= OFF_UNIT)).tolist():
        turn = pycolmap.Rotation3d(quats[row] / lengths[row])
        frames[row].rig_from_world = pycolmap.Rigid3d(turn, frames[row].rig_from_world.translation)
    return length_notes(quats[good], "poses")


def refreshed(model: Model, reconstruction: pycolmap.Reconstruction, xyz: Floats | None = None) -> Model:
    """The content with the poses and positions of a reconstruction of the same images and points.

    A point that the reconstruction lost stays where it was. `xyz (P, 3)`: its positions, where they are known already.
    """
    if xyz is None:
        points3d, xyz = reconstruction.points3D, model.points.xyz.copy()
        for row, point_id in enumerate(model.points.ids.tolist()):
            if point_id in points3d:
                xyz[row] = points3d[point_id].xyz
    images = [replace(image, world_from_cam=_pose(reconstruction.images[image.image_id])) for image in model.images]
    cameras = {
        key: replace(record, params=tuple(reconstruction.cameras[key].params)) for key, record in model.cameras.items()
    }
    return model.moved(cameras, images, xyz)


def _rig_files(folder: Path, ending: str) -> tuple[Path, ...]:
    """`rigs` and `frames` of a model, empty where it is of the older kind that has neither."""
    paths = tuple(folder / f"{name}{ending}" for name in MODEL_FILES[3:])
    there = [path for path in paths if path.is_file()]
    if len(there) == 1:
        lost = next(path for path in paths if path not in there)
        raise SourceError(f"{lost}: is not there, but {there[0].name} is: copy both, or move {there[0].name} away")
    return paths if there else ()


def _without_points(files: Sequence[Path], ending: str) -> pycolmap.Reconstruction:
    with tempfile.TemporaryDirectory(prefix="hodge-colmap-") as scratch:
        for file in files:
            (Path(scratch) / file.name).symlink_to(file.absolute())
        (Path(scratch) / f"points3D{ending}").write_bytes(b"" if ending == ".txt" else struct.pack("<Q", 0))
        try:
            return read_reconstruction(Path(scratch))
        except SourceError as error:
            raise SourceError(str(error).replace(scratch, str(files[0].parent))) from error


def _reason(said: str) -> str:
    for pattern, meaning in REFUSALS:
        found = re.search(pattern, said)
        if found:
            return meaning.format(*found.groups())
    return f"COLMAP itself cannot read this model ({said.strip().splitlines()[-1][-200:]})"


def _check(model: Model, where: Path) -> None:
    if not model.images:
        raise SourceError(f"{where}: the model has no image with a pose: give one that was reconstructed")
    for camera in model.cameras.values():
        wide = max(camera.width, camera.height) >= MOST_PIXELS or min(camera.width, camera.height) < 1
        if wide or not np.isfinite(camera.params).all():
            raise SourceError(
                f"{where}: camera {camera.camera_id} of {camera.width}x{camera.height} has no sound numbers: mend it"
            )
    names = [image.name for image in model.images]
    twice = [name for name, after in pairwise(names) if name == after]
    if twice:
        raise SourceError(f"{where}: two images have the name {twice[0]!r}: rename one, or leave it out")
    for image in model.images:
        # features of no point may be none: COLMAP undistorts those beyond what a lens model can do to NaN
        if not np.isfinite(image.pixels[image.point_ids != NO_POINT]).all():
            raise SourceError(f"{where}: image {image.name!r}: an observation is not finite: reconstruct it again")
        lost = image.point_ids[(image.point_ids != NO_POINT) & (model.points.rows_of(image.point_ids) < 0)]
        if lost.size:
            raise SourceError(f"{where}: image {image.name!r} observes point {lost[0]}, which is not there: {REMEDY}")


def _pose(image: pycolmap.Image) -> Floats:
    """COLMAP's `cam_from_world`, inverted: the one place where this is done."""
    return se3.inverse(matrix_of(image.cam_from_world()))
