"""Point clouds in messages: PointCloud2 and Foxglove's PointCloud by the fields they describe, Livox's CustomMsg."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hodge_adapters.clouds.columns import coarse_step, far_corner, is_time, points_of_columns, unpacked
from hodge_adapters.mcap.fields import Message, Payload, part, parts, pose_values, text, whole
from hodge_adapters.mcap.records import Malformed
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, PointCloud

MAX_POINTS = 1 << 26
"""No scanner gives 64 million points at once; a message that says so would only exhaust memory."""

_ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FOXGLOVE_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
_LIVOX_POINT = (("offset_time", "u4", 0), ("x", "f4", 4), ("y", "f4", 8), ("z", "f4", 12))
_LIVOX_STEPS = (19, 20)
"""Bytes from one point to the next: of ROS 1, and of CDR, which begins each at a multiple of 4."""
_READ_FIELDS = (
    "x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "rgba", "red", "green", "blue"
)  # fmt: skip


@dataclass(frozen=True)
class CloudLayout:
    """How the bytes of a cloud are to be read: `fields` are (name, numpy type with byte order, offset in a point).

    `cloud_from_points` (16 numbers by rows) moves the points into the frame of the message, None where they are in it.
    """

    width: int
    height: int
    point_step: int
    row_step: int
    fields: tuple[tuple[str, str, int], ...]
    cloud_from_points: tuple[float, ...] | None


def ros_layout(message: Message, length: int) -> CloudLayout:
    """The layout of a PointCloud2 whose data has `length` bytes; raises `Malformed` where it does not fit."""
    order = ">" if message.get("is_bigendian") else "<"
    width, height, step = whole(message, "width"), whole(message, "height"), whole(message, "point_step")
    fields = [
        (text(field, "name"), order + _ROS_TYPES.get(whole(field, "datatype"), ""), whole(field, "offset"))
        for field in parts(message, "fields")
    ]
    return _checked(width, height, step, whole(message, "row_step") or width * step, fields, length, None)


def foxglove_layout(message: Message, length: int) -> CloudLayout:
    """The layout of a Foxglove PointCloud whose data has `length` bytes; raises `Malformed` where it does not fit."""
    step = whole(message, "point_stride")
    fields = [
        (text(field, "name"), "<" + _FOXGLOVE_TYPES.get(whole(field, "type"), ""), whole(field, "offset"))
        for field in parts(message, "fields")
    ]
    width = length // step if step > 0 else 0
    return _checked(width, 1, step, width * step, fields, length, _pose(message))


def livox_layout(message: Message, length: int, contents: bytes) -> CloudLayout:
    """The layout of a CustomMsg, of which `data` is its field `points`; raises `Malformed` where it has none."""
    points = message.get("points")
    if not isinstance(points, slice) or points.step not in _LIVOX_STEPS:
        raise Malformed("no points as Livox's drivers write them")
    step = int(points.step)
    count = -(-length // step)  # CDR leaves out what would follow the last point
    order = ">" if step == _LIVOX_STEPS[1] and not contents[1] & 1 else "<"
    fields = [(name, order + kind, offset) for name, kind, offset in _LIVOX_POINT]
    return _checked(count, 1, step, count * step, fields, count * step, None)


def read_points(payload: Payload, layout: CloudLayout) -> PointCloud:
    """The finite points, with the colours and normals that the message has; raises `SourceError`."""
    columns = _columns(payload, layout, payload.read())
    cloud = points_of_columns(payload.path, unpacked({name: columns[name] for name, _, _ in layout.fields}))
    if layout.cloud_from_points is None:
        return cloud
    motion = np.array(layout.cloud_from_points).reshape(4, 4)
    points = se3.transform(motion, cloud.points_in_cam.astype(np.float64)).astype(np.float32)
    normals = cloud.normals_in_cam
    turned = None if normals is None else (normals @ motion[:3, :3].T).astype(np.float32)
    return replace(cloud, points_in_cam=points, normals_in_cam=turned)


def is_rounded(payload: Payload, layout: CloudLayout) -> bool:
    """Whether the points lie so far from zero that float32 rounds them, here or where they were written; raises
    `SourceError`.
    """
    columns = _columns(payload, layout, payload.read())
    axes = {axis: columns[axis] for axis in "xyz"}
    return any(far_corner(axes, 1.0)) or coarse_step(axes, 1.0) > 0


def _checked(
    width: int,
    height: int,
    step: int,
    row_step: int,
    fields: list[tuple[str, str, int]],
    length: int,
    pose: Floats | None,
) -> CloudLayout:
    if width < 0 or height < 0 or step <= 0 or width * height > MAX_POINTS:
        raise Malformed("a cloud of more points than 64 million, or of points without a size")
    if width * height and (not width * step <= row_step <= length or row_step * (height - 1) + width * step > length):
        raise Malformed("a cloud with fewer bytes than its size needs")
    wanted = tuple(field for field in fields if field[0] in _READ_FIELDS or (is_time(field[0]) and _fits(field, step)))
    if {"x", "y", "z"} - {name for name, _, _ in wanted}:
        raise Malformed("a cloud without the fields x, y and z")
    if len({name for name, _, _ in wanted}) < len(wanted):
        raise Malformed("a cloud with two fields of one name")
    for name, kind, offset in wanted:
        if not _fits((name, kind, offset), step):
            raise Malformed(f"a cloud whose field {name} does not lie in its points")
    flat = None if pose is None else tuple(pose.reshape(-1).tolist())
    return CloudLayout(width, height, step, row_step, wanted, flat)


def _fits(field: tuple[str, str, int], step: int) -> bool:
    """Whether a field (name, type, offset) has a known type and lies in a point of `step` bytes."""
    _, kind, offset = field
    return len(kind) >= 3 and 0 <= offset <= step - np.dtype(kind).itemsize


def _pose(message: Message) -> Floats | None:
    pose = part(message, "pose")
    if not pose:
        return None
    values = np.array(pose_values(part(pose, "position"), part(pose, "orientation")))
    motion = se3.from_quat_xyzw(values[:3], values[3:])
    return None if np.array_equal(motion, np.eye(4)) else motion


def _columns(payload: Payload, layout: CloudLayout, contents: bytes) -> NDArray[np.void]:
    names, kinds, offsets = zip(*layout.fields, strict=True)
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets})
    shape, strides = (layout.height, layout.width), (layout.row_step, layout.point_step)
    if not layout.width * layout.height:
        return np.zeros(0, dtype)
    if len(contents) < layout.row_step * (layout.height - 1) + (layout.width - 1) * layout.point_step + dtype.itemsize:
        raise payload.error("a cloud with fewer bytes than its size needs")
    return np.asarray(np.ndarray(shape, dtype, contents, 0, strides).reshape(-1))
