"""What the lines of a pose graph hold, of g2o and TORO alike, as a source."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hodge_adapters.pose_graphs.g2o_switches import SWITCH_TAGS
from hodge_adapters.pose_graphs.text import LANDMARK_TAGS, Records
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Ints, Priors, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted

SKIPPED_TAGS_SHOWN = 5
"""Kinds of lines that are not read, each with a note of its own: a limit on length."""


@dataclass(frozen=True)
class Content:
    """The vertices, edges and priors of one dimension, each in the order of its lines.

    - `vertex_keys (V,)` and `poses (V, 4, 4)`, world from vertex.
    - `edge_keys (E, 2)`, `motions (E, 4, 4)` of the second in the first, `information (E, 6, 6)` over ξ = (φ, ρ).
    - `prior_keys (P,)`, `prior_poses (P, 4, 4)`, `prior_information (P, 6, 6)`: what is known of single vertices.
    """

    vertex_keys: Ints
    poses: Floats
    edge_keys: Ints
    motions: Floats
    information: Floats
    prior_keys: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    prior_poses: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    prior_information: Floats = field(default_factory=lambda: np.zeros((0, 6, 6)))


def upper_triangle(values: Floats, size: int) -> Floats:
    """Symmetric matrices (N, size, size) of their upper triangles (N, size (size + 1) / 2), row by row."""
    rows, columns = np.triu_indices(size)
    out = np.zeros((len(values), size, size))
    out[:, rows, columns] = out[:, columns, rows] = values
    return out


def has_information(edges: Records, motion: int, notes: list[str]) -> bool:
    """Whether numbers follow those of each edge's motion; a note says where none do. Without edges they do."""
    stated = bool(edges.values.shape[1] > motion)
    if not stated:
        notes.append(f"{counted(len(edges), 'edge states|edges state')} no information: taken as unknown")
    return stated


def rows_of_keys(vertex_keys: Ints, edge_keys: Ints) -> tuple[Ints, Ints]:
    """The vertex ids in the file's order, then those that only edges name, and the edges as rows of them (E, 2)."""
    every = np.concatenate([vertex_keys, edge_keys.reshape(-1)])
    unique, first, inverse = np.unique(every, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(unique), np.int64)
    rank[order] = np.arange(len(unique))
    return unique[order], rank[inverse.reshape(-1)[len(vertex_keys) :]].reshape(-1, 2)


def as_source(path: Path, content: Content, kind: str, fixed_keys: Ints, dimension: int, notes: list[str]) -> Source:
    """What the file holds: the graph, and the vertex poses as a trajectory whose stamps are row numbers, where every
    vertex has one; notes what was incomplete.
    """
    ids, edges = rows_of_keys(content.vertex_keys, content.edge_keys)
    named = len(content.vertex_keys)
    if 0 < named < len(ids):
        notes.append(f"{len(ids) - named} of {len(ids)} vertices are named by edges only: no initial poses")
    fixed = np.flatnonzero(np.isin(ids, fixed_keys)).astype(np.int64)
    if len(fixed):
        notes.append(f"{counted(len(fixed), 'vertex is|vertices are')} marked FIX")
    motions, information = content.motions, content.information
    if count := int((edges[:, 0] == edges[:, 1]).sum()):
        notes.append(f"{counted(count, 'edge joins|edges join')} a vertex to itself: they say nothing of poses")
    graph = ViewGraph.from_edges(ids, edges, motions, information, kind, dimension=dimension, fixed=fixed)
    priors = _priors(content, ids, path)
    if priors is not None:
        notes.append(
            f"{counted(len(priors.vertices), 'prior of a single vertex is|priors of single vertices are')} read"
        )
        graph = replace(graph, priors=priors)
    trajectory = Trajectory(np.arange(named, dtype=float), content.poses) if named == len(ids) else None
    return Source(path.stem, path, trajectory=trajectory, graph=graph, notes=tuple(notes), files=(path,))


def _priors(content: Content, ids: Ints, path: Path) -> Priors | None:
    """What is known of single vertices (V,); None where nothing is."""
    if not len(content.prior_keys):
        return None
    row_of = {name: row for row, name in enumerate(ids.tolist())}
    keys = content.prior_keys.tolist()
    unknown = [key for key in keys if key not in row_of]
    if unknown:
        raise SourceError(f"{path}: a prior names vertex {unknown[0]}, which no vertex or edge line names")
    rows = np.array([row_of[key] for key in keys], np.int64)
    return Priors(rows, content.prior_poses, content.prior_information)


def skipped(other: dict[str, int]) -> list[str]:
    """A note for each kind of line that is not read, with its count."""
    shown = sorted(other.items(), key=lambda item: -item[1])
    notes = [
        f"{counted(count, 'line')} of kind {tag} not read{_meaning(tag)}" for tag, count in shown[:SKIPPED_TAGS_SHOWN]
    ]
    if len(shown) > SKIPPED_TAGS_SHOWN:
        rest = shown[SKIPPED_TAGS_SHOWN:]
        notes.append(f"{sum(count for _, count in rest)} lines of {len(rest)} more kinds are not read")
    return notes


def _meaning(tag: str) -> str:
    if tag in SWITCH_TAGS:
        return ": switches of loops, which are judged anew"
    return ": landmarks, where only edges between poses are solved" if tag in LANDMARK_TAGS else ""


def refuse_landmarks_alone(path: Path, other: dict[str, int]) -> None:
    """Raise `SourceError` for a file without poses that has landmarks."""
    tags = sorted(LANDMARK_TAGS & set(other))
    if tags:
        raise SourceError(f"{path}: holds landmarks alone ({', '.join(tags)}): edges between poses are needed")
