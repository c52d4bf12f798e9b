"""TORO (and iSAM) pose graphs: VERTEX2/3, EDGE2/3, ODOMETRY and EQUIV lines with Euler angles, information in radians.

Two dialects of EDGE2 information occur: TORO's own order xx xy yy θθ xθ yθ, and iSAM's, row by row, xx xy xθ yy yθ θθ,
in files without vertices. iSAM writes a square root of the information; since no file says so, it is read as it stands.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as stage
from scipy.spatial.transform import Rotation

from hodge_adapters.pose_graphs.content import (
    Content,
    as_source,
    has_information,
    refuse_landmarks_alone,
    skipped,
    upper_triangle,
)
from hodge_adapters.pose_graphs.planar import lift_information, lift_poses
from hodge_adapters.pose_graphs.text import Records, count_tags, read_records
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Ints, Source

KEYS = {"VERTEX2": 1, "EDGE2": 2, "VERTEX3": 1, "EDGE3": 2, "EQUIV": 2}
COLUMNS = {"VERTEX2": (3,), "EDGE2": (9, 3), "VERTEX3": (6,), "EDGE3": (27, 6), "EQUIV": (0,)}
OTHER_NAMES = {"ODOMETRY": "EDGE2", "EDGE": "EDGE2", "VERTEX": "VERTEX2"}
"""As iSAM names the edges of the vehicle's own path, and as both were named at first."""
TORO_ORDER = np.array([0, 1, 4, 2, 5, 3])
"""Where xx xy xθ yy yθ θθ stand in TORO's xx xy yy θθ xθ yθ."""


def euler_motions(values: Floats) -> Floats:
    """Motions (N, 4, 4) of x y z roll pitch yaw, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    if not len(values):
        return np.zeros((0, 4, 4))
    rotation = np.asarray(Rotation.from_euler("xyz", values[:, 3:6]).as_matrix())
    return se3.from_parts(rotation, values[:, :3])


def _spatial(records: dict[str, Records], notes: list[str]) -> Content:
    vertices, edges = records["VERTEX3"], records["EDGE3"]
    vertices.refuse_repeated("vertex")
    information = np.broadcast_to(np.eye(6), (len(edges), 6, 6))
    if has_information(edges, 6, notes):
        information = np.roll(upper_triangle(edges.values[:, 6:], 6), (3, 3), axis=(1, 2))
    poses, motions = euler_motions(vertices.values), euler_motions(edges.values)
    return Content(vertices.keys[:, 0], poses, edges.keys, motions, np.array(information))


def _planar(records: dict[str, Records], notes: list[str]) -> Content:
    vertices, edges = records["VERTEX2"], records["EDGE2"]
    vertices.refuse_repeated("vertex")
    information = np.broadcast_to(np.eye(3), (len(edges), 3, 3))
    if has_information(edges, 3, notes):
        raw = edges.values[:, 3:]
        by_rows = not len(vertices) and bool((raw[:, 2] == 0).any())
        if by_rows:
            notes.append("information read row by row (iSAM's order): the file has no vertices")
        information = upper_triangle(raw if by_rows else raw[:, TORO_ORDER], 3)
    poses, motions = lift_poses(vertices.values), lift_poses(edges.values[:, :3])
    return Content(vertices.keys[:, 0], poses, edges.keys, motions, lift_information(np.array(information)))


def _merge(content: Content, pairs: Ints) -> Content:
    """The same with vertices that EQUIV pairs join, directly or by others, one vertex: one that is named second."""
    keep_of: dict[int, int] = {}

    def root(key: int) -> int:
        while (kept := keep_of.get(key, key)) != key:
            keep_of[key] = keep_of.get(kept, kept)  # half the way for the next
            key = kept
        return key

    for a, b in pairs.tolist():
        if (joined := root(a)) != root(b):
            keep_of[joined] = root(b)
    merged = np.array([root(int(key)) for key in content.edge_keys.reshape(-1)], np.int64).reshape(-1, 2)
    kept = np.array([root(int(key)) == key for key in content.vertex_keys], bool)
    return Content(content.vertex_keys[kept], content.poses[kept], merged, content.motions, content.information)


def load_toro(path: Path | str) -> Source:
    """The pose graph of a TORO file, and its vertices as a trajectory where it has them all.

    Raises `SourceError` with file and line where one is malformed.
    """
    path = Path(path)
    records, other = read_records(path, KEYS, COLUMNS, OTHER_NAMES)
    spatial, planar = len(records["EDGE3"]), len(records["EDGE2"])
    if spatial and planar:
        raise SourceError(f"{path}: holds both EDGE3 and EDGE2: split it, one dimension to a file")
    if not spatial and not planar:
        refuse_landmarks_alone(path, other)
        raise SourceError(f"{path}: no TORO edge in it: expected lines such as EDGE3 or EDGE2")
    notes = skipped(other)
    content = (_planar if planar else _spatial)(records, notes)
    if len(equal := records["EQUIV"].keys):
        content = _merge(content, equal)
        notes.append(f"{len(equal)} EQUIV lines: those vertices are merged")
    return as_source(path, content, "toro", np.zeros(0, np.int64), 2 if planar else 3, notes)


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class ToroReader:
    """Opens a TORO or iSAM file as a measured graph; 2-D graphs are lifted into the plane z = 0."""

    def sniff(self, path: Path) -> Sniff:
        """How sure it is: by the tags of the first lines."""
        known = [tag for tag in count_tags(path) if tag in KEYS or tag in OTHER_NAMES]
        if known:
            return Sniff(0.9, f"lines of kind {known[0]}")
        return Sniff(0.0, "no TORO line at its beginning")

    def open(self, path: Path) -> Source:
        """The graph, and the vertices as a trajectory whose stamps are row numbers, where the file has them all."""
        return load_toro(path)
