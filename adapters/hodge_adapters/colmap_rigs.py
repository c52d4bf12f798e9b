"""COLMAP's rigs and frames: several cameras fixed to each other, posed together. `sensor_from_rig · rig_from_world`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

import numpy as np

from hodge_adapters.colmap_binary import Cursor, opened
from hodge_adapters.colmap_records import REMEDY, ImageRecord, world_from_cam
from hodge_adapters.colmap_text import fault, lines, whole
from hodge_adapters.text_rows import to_floats
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats

CAMERA = 0
SENSOR_TYPES = {"CAMERA": CAMERA, "IMU": 1}
SAME_POSE = 1e-6
"""Radians and units: a pose of an image that differs from that of its frame by more is another one."""

Sensor: TypeAlias = tuple[int, int]
"""Type and id."""

Rigs: TypeAlias = Mapping[int, Mapping[Sensor, Floats | None]]
"""For each rig `rig_from_sensor` (4, 4) of each sensor, None where it was never found."""


@dataclass(frozen=True)
class RigFrame:
    """One moment of a rig: its pose, and the (sensor, data id) recorded then; of a camera the data are an image."""

    frame_id: int
    rig_id: int
    world_from_rig: Floats
    data: Sequence[tuple[Sensor, int]]


def rig_files(folder: Path, ending: str) -> tuple[Path, ...]:
    """`rigs` and `frames` of a model, empty where it is of the older kind that has neither."""
    paths = tuple(folder / f"{name}{ending}" for name in ("rigs", "frames"))
    there = [path for path in paths if path.is_file()]
    if len(there) == 1:
        lost = next(path for path in paths if path not in there)
        raise SourceError(f"{lost}: is not there, but {there[0].name} is: copy both, or move {there[0].name} away")
    return paths if there else ()


def posed_by_rigs(images: Sequence[ImageRecord], paths: Sequence[Path], notes: list[str]) -> list[ImageRecord]:
    """The images with the poses that the rigs and frames give them; what does not agree is counted in the notes.

    COLMAP takes a pose from there as well, and writes it to the image's own record only for older readers.
    """
    text = paths[0].suffix == ".txt"
    rigs = (_text_rigs if text else _binary_rigs)(paths[0])
    frames = (_text_frames if text else _binary_frames)(paths[1])
    poses = _poses_of_images(rigs, frames, paths[1])
    found = [replace(image, world_from_cam=poses.get(image.image_id, image.world_from_cam)) for image in images]
    alone = sum(image.image_id not in poses for image in images)
    if alone:
        notes.append(f"{alone} of {len(images)} images are in no frame of a posed sensor: their own poses are taken")
    own = np.array([image.world_from_cam for image in images]).reshape(-1, 4, 4)
    away = se3.log(se3.inverse(own) @ np.array([image.world_from_cam for image in found]).reshape(-1, 4, 4))
    moved = int((np.abs(away).max(axis=-1, initial=0.0) > SAME_POSE * (1 + np.abs(own).max(initial=0.0))).sum())
    if moved:
        notes.append(f"{moved} of {len(images)} images have another pose than their rig's frame: the frame's is taken")
    several = [rig for rig in rigs.values() if len(rig) > 1]
    if several:
        notes.append(f"{len(several)} of {len(rigs)} rigs have more than one sensor: {len(frames)} frames of rigs")
    return found


def _poses_of_images(rigs: Rigs, frames: Sequence[RigFrame], path: Path) -> dict[int, Floats]:
    """`world_from_cam` by image id."""
    poses: dict[int, Floats] = {}
    for frame in frames:
        if frame.rig_id not in rigs:
            raise SourceError(f"{path}: frame {frame.frame_id} is of rig {frame.rig_id}, which is not there: {REMEDY}")
        for sensor, data_id in frame.data:
            if sensor[0] != CAMERA:
                continue
            if sensor not in rigs[frame.rig_id]:
                where = f"{path}: frame {frame.frame_id}"
                raise SourceError(f"{where} has an image of camera {sensor[1]}, which its rig has not: {REMEDY}")
            if data_id in poses:
                raise SourceError(f"{path}: image {data_id} is in two frames: {REMEDY}")
            rig_from_cam = rigs[frame.rig_id][sensor]
            if rig_from_cam is not None:
                poses[data_id] = frame.world_from_rig @ rig_from_cam
    return poses


def _binary_rigs(path: Path) -> Rigs:
    rigs: dict[int, Mapping[Sensor, Floats | None]] = {}
    with opened(path) as cursor:
        for _ in range(cursor.count(8)):
            rig_id, count = (int(value) for value in cursor.take("<II"))
            rigs[rig_id] = _checked(f"{path}: rig {rig_id}", list(_binary_sensors(cursor, count)), rig_id in rigs)
        cursor.end()
    return rigs


def _binary_sensors(cursor: Cursor, count: int) -> Iterator[tuple[Sensor, Floats | None]]:
    """The reference sensor, which is the rig itself, then the others."""
    for row in range(count):
        kind, sensor_id = (int(value) for value in cursor.take("<iI"))
        where = f"{cursor.path}: sensor {sensor_id}"
        if row == 0:
            yield (kind, sensor_id), np.eye(4)
        elif cursor.take("<B")[0]:
            pose = cursor.take("<7d")
            yield (kind, sensor_id), world_from_cam(where, pose[:4], pose[4:])
        else:
            yield (kind, sensor_id), None


def _binary_frames(path: Path) -> list[RigFrame]:
    frames = []
    with opened(path) as cursor:
        for _ in range(cursor.count(68)):
            frame_id, rig_id, *pose, count = cursor.take("<II7dI")
            where = f"{path}: frame {int(frame_id)}"
            data = []
            for _ in range(int(count)):
                kind, sensor_id, data_id = (int(value) for value in cursor.take("<iIQ"))
                data.append(((kind, sensor_id), data_id))
            frames.append(RigFrame(int(frame_id), int(rig_id), world_from_cam(where, pose[:4], pose[4:]), data))
        cursor.end()
    return frames


def _text_rigs(path: Path) -> Rigs:
    rigs: dict[int, Mapping[Sensor, Floats | None]] = {}
    for line, text in lines(path):
        fields = text.split()
        rig_id, count = whole(path, line, fields[:2]) if len(fields) > 1 else (0, -1)
        sensors = list(_text_sensors(path, line, fields[2:], text))
        if len(sensors) != count:
            raise fault(path, line, text, "RIG_ID NUM_SENSORS and so many sensors")
        rigs[rig_id] = _checked(f"{path}:{line}: rig {rig_id}", sensors, rig_id in rigs)
    return rigs


def _text_sensors(path: Path, line: int, fields: Sequence[str], text: str) -> Iterator[tuple[Sensor, Floats | None]]:
    """The reference sensor, which has no pose, then the others with HAS_POSE and perhaps a pose."""
    if fields:
        yield _text_sensor(path, line, fields, text), np.eye(4)
    at = 2
    while at < len(fields):
        sensor = _text_sensor(path, line, fields[at:], text)
        has_pose = fields[at + 2 : at + 3] == ["1"]
        pose = to_floats(fields[at + 3 : at + 10]) if has_pose else None
        if fields[at + 2 : at + 3] not in (["0"], ["1"]) or (has_pose and (pose is None or len(pose) != 7)):
            raise fault(path, line, text, "SENSOR_TYPE SENSOR_ID HAS_POSE QW QX QY QZ TX TY TZ of each other sensor")
        yield sensor, None if pose is None else world_from_cam(f"{path}:{line}", pose[:4], pose[4:])
        at += 10 if has_pose else 3


def _text_frames(path: Path) -> list[RigFrame]:
    frames = []
    for line, text in lines(path):
        fields = text.split()
        pose = to_floats(fields[2:9])
        if len(fields) < 10 or pose is None:
            raise fault(path, line, text, "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS DATA_IDS")
        frame_id, rig_id, count = whole(path, line, [*fields[:2], fields[9]])
        triples = [fields[at : at + 3] for at in range(10, len(fields), 3)]
        if len(fields) != 10 + 3 * count:
            raise fault(path, line, text, "NUM_DATA_IDS triples of SENSOR_TYPE SENSOR_ID DATA_ID")
        data = [(_text_sensor(path, line, triple, text), whole(path, line, triple[2:])[0]) for triple in triples]
        where = f"{path}:{line}: frame {frame_id}"
        frames.append(RigFrame(frame_id, rig_id, world_from_cam(where, pose[:4], pose[4:]), data))
    return frames


def _text_sensor(path: Path, line: int, fields: Sequence[str], text: str) -> Sensor:
    if len(fields) < 2 or fields[0] not in SENSOR_TYPES:
        raise fault(path, line, text, f"SENSOR_TYPE ({', '.join(SENSOR_TYPES)}) and SENSOR_ID")
    return SENSOR_TYPES[fields[0]], whole(path, line, [fields[1]])[0]


def _checked(
    where: str, sensors: Sequence[tuple[Sensor, Floats | None]], is_known: bool
) -> Mapping[Sensor, Floats | None]:
    names = sorted(sensor for sensor, _ in sensors)
    if is_known or any(len(list(same)) > 1 for _, same in groupby(names)):
        raise SourceError(f"{where}: is given twice, or has a sensor twice: {REMEDY}")
    return dict(sensors)
