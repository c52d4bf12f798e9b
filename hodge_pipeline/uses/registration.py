"""Register clouds that are in memory: arrays, Open3D's clouds or ours, without a run folder or workers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from hodge_pipeline.complex.checks import check_motions
from hodge_pipeline.errors import GraphError, SourceError
from hodge_pipeline.recipe.binding import stage_of
from hodge_pipeline.stages import Registrar
from hodge_pipeline.types import Edges, Floats, Floats32, Ints, PointCloud, Registration


class Open3dPoints(Protocol):
    """`open3d.geometry.PointCloud`."""

    points: Any
    normals: Any
    colors: Any


Cloud: TypeAlias = PointCloud | Floats | Floats32 | Open3dPoints
"""Points (N, 3) in metres, Open3D's cloud, or ours."""


def register(
    target: Cloud,
    source: Cloud,
    i_from_j: Floats | None = None,
    *,
    registrar: str | Registrar = "gicp",
    **options: Any,
) -> Registration:
    """The motion `i_from_j` that lays `source` (j) onto `target` (i), with its information (6, 6), fitness and RMSE.

    The guess `i_from_j (4, 4)` defaults to the identity; how far off it may be depends on the registrar.
    `registrar` is a name (`hodge stages registration`), with `options` such as `distances_m=(1.0, 0.3)`, or a stage.
    Lengths are metres. The information is calibrated on clouds with one point a voxel: down-sample dense ones first.
    Clouds without correspondences give the guess back, with `converged` False. Raises `SourceError` for what is no
    cloud, `GraphError` for a guess that is no rigid motion, `RecipeError` for an unknown registrar or option.
    """
    guesses = None if i_from_j is None else np.asarray(i_from_j, float)[None]
    stage = stage_of("registration", registrar, options, "register")
    return _register([target, source], np.array([[0, 1]]), guesses, stage)[0]


def register_clouds(
    clouds: Sequence[Cloud],
    pairs: Ints | Sequence[Sequence[int]],
    i_from_j: Floats | None = None,
    *,
    registrar: str | Registrar = "gicp",
    **options: Any,
) -> Edges:
    """A table of registrations, one of each of the `pairs (P, 2)`, rows (i, j) of the clouds; see `register`.

    `i_from_j (P, 4, 4)` are the guesses. `edges.as_graph(ids)` is the viewing graph that `diagnose` and solvers take.
    Raises as `register`, and `GraphError` for a pair without a cloud.
    """
    rows = np.asarray(pairs, np.int64).reshape(-1, 2)
    stage = stage_of("registration", registrar, options, "register_clouds")
    name = registrar if isinstance(registrar, str) else type(registrar).__name__
    return Edges.of(rows, name).with_registrations(_register(clouds, rows, i_from_j, stage))


def _register(clouds: Sequence[Cloud], pairs: Ints, guesses: Floats | None, stage: Registrar) -> list[Registration]:
    """The registration of each pair (P, 2) from its guess (P, 4, 4); each cloud is prepared once."""
    if len(pairs) and (pairs.min() < 0 or pairs.max() >= len(clouds)):
        raise GraphError(f"pairs name cloud {pairs.max()} or {pairs.min()}: give rows from 0 to {len(clouds) - 1}")
    motions = np.tile(np.eye(4), (len(pairs), 1, 1)) if guesses is None else np.asarray(guesses, float)
    if motions.shape != (len(pairs), 4, 4):
        raise GraphError(f"guesses have the shape {motions.shape}: expected ({len(pairs)}, 4, 4), one for each pair")
    check_motions(motions, "guesses", lambda row: f"the guess i_from_j of pair {tuple(pairs[row].tolist())}")
    prepared = {row: stage.prepare(_cloud(clouds[row], row)) for row in np.unique(pairs).tolist()}
    return [stage.register(prepared[i], prepared[j], m) for (i, j), m in zip(pairs.tolist(), motions, strict=True)]


def _cloud(given: Cloud, row: int) -> PointCloud:
    """The cloud as ours. Raises `SourceError` for other shapes."""
    if isinstance(given, PointCloud):
        return given
    points = np.asarray(getattr(given, "points", given), np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SourceError(f"cloud {row} has the shape {points.shape}: expected points (N, 3), in metres")
    normals, colours = (_column(given, name, len(points)) for name in ("normals", "colors"))
    return PointCloud(
        points, normals, None if colours is None else np.clip(np.round(colours * 255), 0, 255).astype(np.uint8)
    )


def _column(given: Any, name: str, count: int) -> Floats32 | None:
    """A column (N, 3) of Open3D's cloud; None where it has none."""
    values = np.asarray(getattr(given, name, ()), np.float32)
    return values if count and values.shape == (count, 3) else None
