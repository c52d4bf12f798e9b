"""g2o pose graphs, 2-D and 3-D: vertices, edges, FIX, 64-bit keys. Its conventions are met here and nowhere else.

A g2o information matrix is over (translation, q_vec): half an angle. Ours is over (rotation, translation) in radians.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as stage

from hodge_adapters.pose_graphs import g2o_priors, g2o_switches
from hodge_adapters.pose_graphs.content import (
    Content,
    as_source,
    has_information,
    refuse_landmarks_alone,
    skipped,
    upper_triangle,
)
from hodge_adapters.pose_graphs.planar import flatten_information, flatten_poses, lift_information, lift_poses
from hodge_adapters.pose_graphs.text import LANDMARK_TAGS, Records, count_tags, read_records, write_lines
from hodge_adapters.posed import graph_of, length_notes, written_graph
from hodge_adapters.text_rows import write_text_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Source, ViewGraph

HALF_ANGLE = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
"""d(q_vec, t) / d(φ, ρ) at the identity."""


def information_of_file(information: Floats) -> Floats:
    """Matrices over ξ = (φ, ρ) (E, 6, 6) of a g2o file's over (t, q_vec): q_vec = φ / 2."""
    swapped = np.roll(information, (3, 3), axis=(-2, -1))
    return np.asarray(swapped * np.outer(HALF_ANGLE, HALF_ANGLE))


def information_for_file(information: Floats) -> Floats:
    """A g2o file's matrices over (t, q_vec) (E, 6, 6) of ours over ξ = (φ, ρ)."""
    return np.roll(information / np.outer(HALF_ANGLE, HALF_ANGLE), (-3, -3), axis=(-2, -1))


def spatial_poses(records: Records) -> Floats:
    """Motions (N, 4, 4) of x y z qx qy qz qw; a zero quaternion is refused with its line."""
    quat = records.values[:, 3:7]
    records.refuse(np.linalg.norm(quat, axis=1) < 1e-9, "its quaternion is zero")
    return se3.from_quat_xyzw(records.values[:, :3], quat)


def _spatial(records: dict[str, Records], notes: list[str]) -> Content:
    vertices, edges = records["VERTEX_SE3:QUAT"], records["EDGE_SE3:QUAT"]
    vertices.refuse_repeated("vertex")
    information = np.tile(np.eye(6), (len(edges), 1, 1))
    if has_information(edges, 7, notes):
        information = information_of_file(upper_triangle(edges.values[:, 7:], 6))
    poses, motions = spatial_poses(vertices), spatial_poses(edges)
    plain, levered = records[g2o_priors.SPATIAL], records[g2o_priors.SPATIAL_OFFSET]
    parameters = records[g2o_priors.OFFSET]
    offsets = g2o_priors.offsets_of(levered, parameters, spatial_poses(parameters))
    known = [information_of_file(upper_triangle(prior.values[:, 7:], 6)) for prior in (plain, levered)]
    moved, moved_information = g2o_priors.moved_to_body(spatial_poses(levered), known[1], offsets)
    on_position = records[g2o_priors.SPATIAL_XYZ], records[g2o_priors.SPATIAL_XY]
    places, of_places = zip(*map(_positions, on_position, (3, 2)), strict=True)
    return Content(
        vertices.keys[:, 0],
        poses,
        edges.keys,
        motions,
        information,
        np.concatenate([prior.keys[:, 0] for prior in (plain, levered, *on_position)]),
        np.concatenate([spatial_poses(plain), moved, *places]),
        np.concatenate([known[0], moved_information, *of_places]),
    )


def _positions(known: Records, size: int) -> tuple[Floats, Floats]:
    """Poses (P, 4, 4) at known positions of so many coordinates, and the information (P, 6, 6) on these alone."""
    beside = (0, 3 - size)
    at = np.pad(known.values[:, :size], ((0, 0), beside))
    around = ((0, 0), (3, beside[1]), (3, beside[1]))
    information = np.pad(upper_triangle(known.values[:, size:], size), around)
    return se3.from_parts(np.broadcast_to(np.eye(3), (len(at), 3, 3)), at), information


def _planar(records: dict[str, Records], notes: list[str]) -> Content:
    vertices, edges = records["VERTEX_SE2"], records["EDGE_SE2"]
    vertices.refuse_repeated("vertex")
    information = np.tile(np.eye(3), (len(edges), 1, 1))
    if has_information(edges, 3, notes):
        information = upper_triangle(edges.values[:, 3:], 3)
    poses, motions = lift_poses(vertices.values), lift_poses(edges.values[:, :3])
    whole, position = records[g2o_priors.PLANAR], records[g2o_priors.PLANAR_POSITION]
    anywhere = np.pad(position.values[:, :2], ((0, 0), (0, 1)))
    on_position = np.pad(upper_triangle(position.values[:, 2:], 2), ((0, 0), (0, 1), (0, 1)))
    return Content(
        vertices.keys[:, 0],
        poses,
        edges.keys,
        motions,
        lift_information(information),
        np.concatenate([whole.keys[:, 0], position.keys[:, 0]]),
        lift_poses(np.concatenate([whole.values[:, :3], anywhere])),
        lift_information(np.concatenate([upper_triangle(whole.values[:, 3:], 3), on_position])),
    )


KEYS = {"VERTEX_SE3:QUAT": 1, "EDGE_SE3:QUAT": 2, "VERTEX_SE2": 1, "EDGE_SE2": 2, "FIX": 1}
KEYS |= g2o_priors.KEYS | g2o_switches.KEYS
SPATIAL_TAGS = (
    *("VERTEX_SE3:QUAT", g2o_priors.SPATIAL, g2o_priors.SPATIAL_OFFSET, g2o_priors.OFFSET),
    *(g2o_priors.SPATIAL_XYZ, g2o_priors.SPATIAL_XY),
)
PLANAR_TAGS = ("VERTEX_SE2", g2o_priors.PLANAR, g2o_priors.PLANAR_POSITION)
COLUMNS = {
    "VERTEX_SE3:QUAT": (7,),
    "EDGE_SE3:QUAT": (28, 7),
    "VERTEX_SE2": (3,),
    "EDGE_SE2": (9, 3),
    "FIX": None,
    **g2o_priors.COLUMNS,
    **g2o_switches.COLUMNS,
}
"""Edges without information are what LIO-SAM's descendants write."""


def load_g2o(path: Path | str) -> Source:
    """The pose graph of a g2o file, and its vertices as a trajectory where it has them all.

    Raises `SourceError` with file and line where one is malformed.
    """
    path = Path(path)
    records, other = read_records(path, KEYS, COLUMNS)
    records, told = g2o_switches.as_edges(records)
    spatial, planar = len(records["EDGE_SE3:QUAT"]), len(records["EDGE_SE2"])
    if spatial and planar:
        raise SourceError(f"{path}: holds both EDGE_SE3:QUAT and EDGE_SE2: split it, one dimension to a file")
    if not spatial and not planar and not len(records["VERTEX_SE3:QUAT"]) and not len(records["VERTEX_SE2"]):
        refuse_landmarks_alone(path, other)
        raise SourceError(f"{path}: no g2o vertex or edge in it: expected lines such as EDGE_SE3:QUAT or EDGE_SE2")
    more_planar = len(records["VERTEX_SE2"]) > len(records["VERTEX_SE3:QUAT"])
    dimension = 2 if planar or (not spatial and more_planar) else 3
    content = (_planar if dimension == 2 else _spatial)(records, told)
    strange = {tag: len(records[tag]) for tag in (SPATIAL_TAGS if dimension == 2 else PLANAR_TAGS) if len(records[tag])}
    notes = skipped({**other, **strange}) + told
    for tag, what in (("VERTEX_SE3:QUAT", "vertices"), ("EDGE_SE3:QUAT", "edges")):
        notes += length_notes(records[tag].values[:, 3:7], what)
    fixed_keys = records["FIX"].keys.reshape(-1)
    absent = np.setdiff1d(fixed_keys, np.concatenate([content.vertex_keys, content.edge_keys.reshape(-1)]))
    if len(absent):
        if not any(tag.startswith("VERTEX") for tag in {**other, **strange}):
            raise SourceError(
                f"{path}: FIX names vertex {absent[0]}, which no vertex or edge line names: mend that line"
            )
        notes.append(f"{len(absent)} FIX lines name vertices that are not read, {absent[0]} first: ignored")
    return as_source(path, content, "g2o", fixed_keys, dimension, notes)


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class G2oReader:
    """Opens a g2o file as a measured graph; 2-D graphs are lifted into the plane z = 0."""

    def sniff(self, path: Path) -> Sniff:
        """How sure it is: by the tags of the first lines."""
        tags = count_tags(path)
        known = [tag for tag in tags if tag in KEYS]
        if known:
            return Sniff(0.95, f"lines of kind {known[0]}")
        landmarks = sorted(LANDMARK_TAGS & set(tags))
        if landmarks:
            return Sniff(0.5, f"landmarks: lines of kind {landmarks[0]}")
        return Sniff(0.2 if path.suffix == ".g2o" else 0.0, "no g2o line at its beginning")

    def open(self, path: Path) -> Source:
        """The graph, and the vertices as a trajectory whose stamps are row numbers, where the file has them all."""
        return load_g2o(path)


def write_g2o(path: Path | str, graph: ViewGraph, world_from_vertex: Floats | None = None) -> None:
    """One g2o file, written atomically: ids, order and values survive a round trip to the last bit of a float64.

    A graph of dimension 2 becomes SE2 lines; vertices with names, which g2o cannot hold, are numbered by their rows.
    """
    dimension = graph.dimension
    named = graph.vertex_ids.dtype.kind not in "iu"
    ids = np.arange(graph.vertex_count) if named else graph.vertex_ids.astype(np.int64)
    lines: list[str] = []
    vertex_tag, edge_tag = ("VERTEX_SE2", "EDGE_SE2") if dimension == 2 else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    if world_from_vertex is not None:
        write_lines(lines, vertex_tag, ids[:, None], _pose_columns(world_from_vertex, dimension))
    write_lines(lines, "FIX", ids[graph.fixed][:, None], np.zeros((len(graph.fixed), 0)))
    poses, information = _pose_columns(graph.i_from_j, dimension), _information_columns(graph.information, dimension)
    write_lines(lines, edge_tag, ids[graph.edges], np.hstack([poses, information]))
    if graph.priors is not None:
        known = graph.priors
        poses, information = _pose_columns(known.world_from_vertex, dimension), known.information
        columns = _information_columns(information, dimension)
        g2o_priors.write_priors(lines, dimension, ids[known.vertices], poses, columns)
    write_text_atomically(Path(path), "\n".join(lines) + "\n")


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class G2oWriter:
    """Writes a measured graph as g2o, 2-D or 3-D as it is, and the trajectory where it has a pose for each vertex."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically; see `write_g2o`."""
        graph, poses = graph_of(source)
        write_g2o(path, graph, poses)
        return written_graph(source, graph)


def _pose_columns(motions: Floats, dimension: int) -> Floats:
    if dimension == 2:
        return flatten_poses(motions)
    return np.hstack([motions[:, :3, 3], se3.to_quat_xyzw(motions)]) if len(motions) else np.zeros((0, 7))


def _information_columns(information: Floats, dimension: int) -> Floats:
    matrices = flatten_information(information) if dimension == 2 else information_for_file(information)
    rows, columns = np.triu_indices(matrices.shape[-1])
    return np.asarray(matrices[:, rows, columns])
