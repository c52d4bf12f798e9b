"""Compare two runs: their measures, options and the distance of their poses; as tables, a page and a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import not_written
from hodge_pipeline.evaluation.difference import floor_of, length, percent, sign_of
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recording.comparison import record_comparison
from hodge_pipeline.report import raster
from hodge_pipeline.report.contents import GRAPH_NAMES, GraphSummary, Pictures, Report, SourceSummary, paths_of
from hodge_pipeline.report.document import Banner, Document, Picture, Section, Table, markdown, render
from hodge_pipeline.report.plots import draw
from hodge_pipeline.report.scene_pictures import sides
from hodge_pipeline.report.verdict import judge
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import is_clock
from hodge_pipeline.store import yaml_file
from hodge_pipeline.store.artifacts import write_text
from hodge_pipeline.store.workspace import RECIPE_FILE, make_folder
from hodge_pipeline.types import Floats, Model
from hodge_pipeline.types.ply import read_model
from hodge_pipeline.types.text import counted

FEWEST_SHARED = 3
"""Shared frames that fix the alignment of the runs."""
SAME = 0.005
"""A relative difference that whole per cents do not show."""
NOTHING_M = 1e-6
"""A distance of poses below which they are the same: rounding."""
VERDICT = "verdict"
"""The row that holds a sentence."""
SHOWN_MODELS = ("mesh", "cloud")
"""Fused models that are shown, the first that a run has."""

Quantity: TypeAlias = Callable[[Report], float | None]
"""Gives a number of a report, None where it was not measured."""


@dataclass(frozen=True)
class Comparison:
    """Two runs by their `names`, B rigidly aligned to A by the S frames that both have a pose of.

    `a_poses`, `b_poses (S, 4, 4)` are in the world of A, `apart_m (S,)` metres between their positions, `a_from_b`
    moves the world of B. Of fewer than three shared frames S is 0 and `a_from_b` the identity.
    """

    a: Run
    b: Run
    names: tuple[str, str]
    a_poses: Floats
    b_poses: Floats
    a_from_b: Floats
    apart_m: Floats

    @property
    def reports(self) -> tuple[Report, Report]:
        """The report of each run."""
        return self.a.report, self.b.report

    @property
    def is_scanner(self) -> bool:
        """Whether the poses are those of scanners."""
        return self.a.report.source.is_scanner


def compare(a: Run, b: Run) -> Comparison:
    """Two runs, the second aligned to the first. Raises `WorkspaceError` where one has not ended."""
    folders = [run.folder.resolve() for run in (a, b)]
    same = folders[0].name == folders[1].name
    names = (str(a.folder), str(b.folder)) if same else (folders[0].name, folders[1].name)
    rows_a, rows_b = (_posed_rows(run) for run in (a, b))
    shared = [(row, rows_b[key]) for key, row in rows_a.items() if key in rows_b] if _may_share(a, b) else []
    rows = np.array(shared, int).reshape(-1, 2)
    a_poses, b_poses = a.poses[rows[:, 0]], b.poses[rows[:, 1]]
    if len(rows) < FEWEST_SHARED:
        return Comparison(a, b, names, a_poses[:0], b_poses[:0], np.eye(4), np.zeros(0))
    laid = absolute_error(b_poses, a_poses)
    return Comparison(a, b, names, a_poses, laid.aligned, laid.aligned[0] @ se3.inverse(b_poses[0]), laid.per_frame_m)


def _posed_rows(run: Run) -> dict[tuple[str, float], int]:
    """The rows of the frames that have a pose, by sequence and stamp; a single sequence has no name that counts."""
    frames = run.source.frames
    several = len({frame.sequence for frame in frames}) > 1
    known = np.flatnonzero(se3.has_pose(run.poses)).tolist()
    return {(frames[row].sequence if several else "", frames[row].stamp_s): row for row in known}


def _may_share(a: Run, b: Run) -> bool:
    """Whether equal stamps are equal frames: of clocks; of frame numbers if the sources agree in name or length."""
    if all(is_clock(np.array([frame.stamp_s for frame in run.source.frames])) for run in (a, b)):
        return True
    one, two = a.report.source, b.report.source
    return one.name == two.name or one.frames == two.frames


def tables(comparison: Comparison) -> tuple[Table, ...]:
    """A table of the quantities of both runs, and one of the options in which their recipes differ."""
    measured = Table("Measured", ("what", *comparison.names, "B against A"), tuple(_measured(comparison)))
    a, b = (yaml_file.read(run.folder / RECIPE_FILE).data for run in (comparison.a, comparison.b))
    options = tuple(_changed_options(a, b))
    none = "" if options else "None: the recipes are the same."
    return measured, Table("Options that differ", ("option", *comparison.names), options, none, 3)


def _measured(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """The rows of the first table: label, value of A, value of B, change from A to B."""
    a, b = comparison.reports
    floor_m = floor_of(comparison.a.poses[:, :3, 3], comparison.b.poses[:, :3, 3])
    yield "frames", str(a.source.frames), str(b.source.frames), ""
    yield VERDICT, judge(a).headline, judge(b).headline, ""  # with its doubts, as of the truth's clock
    for label, quantity, is_length in _QUANTITIES:
        before, after = _finite(quantity(a)), _finite(quantity(b))
        if before is not None or after is not None:
            floor = floor_m if is_length else 0.0
            cells = (_value(value, is_length, floor) for value in (before, after))
            yield label, *cells, _change_in_words(before, after, floor)
    if len(apart := comparison.apart_m):
        yield "poses apart, mean of the shared frames", "", _apart(float(apart.mean())), ""
        yield "poses apart, largest", "", _apart(float(apart.max())), ""


def _finite(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else value


def _error(what: str, name: str = "") -> Quantity:
    """A field of the trajectory error of the poses of this name, by default the result."""

    def of(report: Report) -> float | None:
        rows = (row for row in report.trajectories if row.name == (name or report.after))
        return next((float(getattr(row, what)) for row in rows), None)

    return of


def _score(kind: str, what: str) -> Quantity:
    """A field of the result's scores on a kind of graph."""

    def of(report: Report) -> float | None:
        if report.scores is None or report.after not in report.scores.names:
            return None
        row = report.scores.names.index(report.after)
        return next((float(getattr(one, what)[row]) for one in report.scores.graphs if one.kind == kind), None)

    return of


def _graph(count: Callable[[GraphSummary], int]) -> Quantity:
    """A count of the viewing graph."""
    return lambda report: None if report.graph is None else count(report.graph)


def _total(what: str) -> Quantity:
    """A field of what all stages took."""
    return lambda report: None if report.total is None else getattr(report.total, what) or None


_QUANTITIES: tuple[tuple[str, Quantity, bool], ...] = (
    ("error of the trajectory (ATE)", _error("ate_rmse_m"), True),
    ("… of the odometry", _error("ate_rmse_m", "odometry"), True),
    ("error from frame to frame (RPE)", _error("rpe_translation_m"), True),
    *((f"score, {name}", _score(kind, "mean_score"), False) for kind, name in GRAPH_NAMES.items()),
    *((f"distance d, {name}", _score(kind, "mean_distance_m"), True) for kind, name in GRAPH_NAMES.items()),
    ("edges", _graph(lambda graph: graph.edges), False),
    ("edges ignored by the solver", _graph(lambda graph: graph.edges_ignored), False),
    ("pairs rejected", _graph(lambda graph: sum(graph.rejected.values())), False),
    ("connected parts", _graph(lambda graph: len(graph.components)), False),
    ("time, s", _total("wall_s"), False),
    ("CPU time, s", _total("cpu_s"), False),
    ("peak memory, MB", _total("peak_mb"), False),
)
"""Label, quantity, and whether it is a length in metres."""


def _value(value: float | None, is_length: bool, floor: float) -> str:
    if value is None:
        return "–"
    return length(value, floor_m=floor) if is_length else f"{value:.4g}" if isinstance(value, float) else str(value)


def _apart(metres: float) -> str:
    return "0" if metres < NOTHING_M else length(metres)


def _change_in_words(a: float | None, b: float | None, floor: float) -> str:
    """The change from a to b in per cent, "same" where it is within half a per cent or the floor."""
    if a is None or b is None:
        return ""
    if not sign_of(a, b, max(SAME * abs(a), floor)):
        return "same"
    return percent((b - a) / a) if a > floor else ""


def _changed_options(a: Any, b: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """(key, value of A, value of B) of options that differ; of different stages the names alone."""
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        a, b = ({str(number): each for number, each in enumerate(one, start=1)} for one in (a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping) and a.get("stage") == b.get("stage"):
        for name in dict.fromkeys((*a, *b)):
            if f"{key}{name}" != "description":
                yield from _changed_options(a.get(name), b.get(name), f"{key}.{name}" if key else str(name))
    elif a != b:
        yield key, _named(a), _named(b)


def _named(value: Any) -> str:
    """The text of an option's value: of a stage its name."""
    if isinstance(value, Mapping) and "stage" in value:
        return str(value["stage"])
    return ", ".join(map(_named, value)) if isinstance(value, list) else "–" if value is None else str(value)


def write_comparison(folder: Path, comparison: Comparison) -> tuple[Path, Path]:
    """The paths of `compare.html` and `compare.rrd`, written into a folder that is made if it is not there.

    Raises `WorkspaceError` where they cannot be written.
    """
    html, recording = folder / "compare.html", folder / "compare.rrd"
    models = _model(comparison.a, np.eye(4)), _model(comparison.b, comparison.a_from_b)
    make_folder(folder)
    try:
        write_text(html, render(_page(comparison, models)))
    except OSError as error:
        raise not_written(html, error) from error
    poses, told = (comparison.a_poses, comparison.b_poses), markdown(tables(comparison))
    is_scanner = comparison.is_scanner
    record_comparison(recording, comparison.names, poses, models, comparison.apart_m, told, is_scanner=is_scanner)
    return html, recording


def _model(run: Run, world_from_run: Floats) -> Model | None:
    """The fused model of a run in the common world; None without one."""
    path = next((run.models[name] for name in SHOWN_MODELS if name in run.models), None)
    if path is None:
        return None
    model = read_model(path)
    turn = world_from_run[:3, :3].astype(np.float32)
    points = np.asarray(se3.transform(world_from_run, model.points_in_world.astype(float)), np.float32)
    normals = None if model.normals_in_world is None else model.normals_in_world @ turn.T
    return Model(model.name, points, normals, model.colours, model.triangles, model.notes)


def _page(comparison: Comparison, models: tuple[Model | None, Model | None]) -> Document:
    (a, b), shared = comparison.names, len(comparison.apart_m)
    laid = (
        f"B is laid onto A by the {counted(shared, 'frame')} that both have."
        if shared
        else "The runs share too few frames."
    )
    judged = zip(comparison.names, map(judge, comparison.reports), strict=True)
    measured, options = tables(comparison)
    numbers = tuple(row for row in measured.rows if row[0] != VERDICT)  # the banners say it, a column would be as wide
    return Document(
        f"{a} and {b}",
        f"A: {comparison.a.folder}. B: {comparison.b.folder}. {laid}",
        tuple(Banner("", f"{name}: {verdict.headline}", verdict.points) for name, verdict in judged),
        sections=(
            Section.of(replace(measured, rows=numbers)),
            Section.of(options),
            Section("The models from four sides", f"Left: {a}. Right: {b}.", pictures=_sides(comparison, models)),
            Section("Trajectories", pictures=tuple(draw(_paths(comparison)))),
        ),
    )


def _paths(comparison: Comparison) -> Report:
    """A report with nothing but the aligned trajectories, which the plots take."""
    named = zip(comparison.names, (comparison.a_poses, comparison.b_poses), strict=True)
    pictures = Pictures(
        paths_of({name: poses for name, poses in named if len(poses)}),
        component=np.zeros(len(comparison.a_poses), np.int64),
    )
    before, after = comparison.names
    return Report("", SourceSummary("", "", 0), before=before, after=after, pictures=pictures)


def _sides(comparison: Comparison, models: tuple[Model | None, Model | None]) -> tuple[Picture, ...]:
    """Both models from the same sides; none where one is missing or the runs share too few frames."""
    first, second = models
    if first is None or second is None or not len(comparison.a_poses) or not len(first.points_in_world):
        return ()
    scenes = [raster.Points.of(one.points_in_world, one.normals_in_world, one.colours) for one in (first, second)]
    views = raster.around(scenes[0], comparison.a_poses, comparison.is_scanner)
    return sides(scenes, views, " | ".join(comparison.names))
