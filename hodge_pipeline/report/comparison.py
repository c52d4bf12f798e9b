"""Two run folders side by side: what was measured, what was chosen, how far their poses are apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import registry, se3
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.evaluation.difference import floor_of, length, percent, sign_of
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.report.document import Table
from hodge_pipeline.report.verdict import GRAPH_NAMES
from hodge_pipeline.scene import is_clock
from hodge_pipeline.store import artifacts, yaml_file
from hodge_pipeline.store.workspace import RECIPE_FILE, is_run_folder
from hodge_pipeline.types import Floats

REPORT = "report.json"
FEWEST_SHARED = 3
SAME = 0.005
"""A relative difference that a whole per cent does not show."""
NOTHING_M = 1e-6
MODELS = ("mesh.ply", "cloud.ply")


@dataclass(frozen=True)
class RunFacts:
    """What a run folder holds of its run: the report's numbers, the recipe, the poses (N, 4, 4) by sequence and stamp.

    `model` is its fused scene, none where it has none.
    """

    name: str
    folder: Path
    report: Mapping[str, Any]
    recipe: Mapping[str, Any]
    keys: tuple[tuple[str, float], ...]
    world_from_cam: Floats
    model: Path | None


@dataclass(frozen=True)
class Comparison:
    """Two runs, B laid onto A: `a_poses`, `b_poses (S, 4, 4)` of the frames that both have, `a_from_b (4, 4)`.

    `apart_m (S,)` is the distance of the positions. Without enough shared frames there are none, and no motion.
    """

    a: RunFacts
    b: RunFacts
    a_poses: Floats
    b_poses: Floats
    a_from_b: Floats
    apart_m: Floats


def read_facts(folder: Path, name: str = "") -> RunFacts:
    """The facts of a run folder. Raises `WorkspaceError` where there is no report in it."""
    path = folder / REPORT
    if not path.is_file():
        remedy = "finish the run first" if is_run_folder(folder) else "give the folder of a run"
        raise WorkspaceError(f"{folder}: holds no {REPORT}: {remedy}")
    try:
        report = artifacts.read_json(path)
    except ValueError as error:
        raise WorkspaceError(f"{path}: cannot be read ({error}): run the recipe again") from error
    recipe = yaml_file.read(folder / RECIPE_FILE).data if (folder / RECIPE_FILE).is_file() else {}
    keys, poses = _poses(folder)
    model = next((folder / model for model in MODELS if (folder / model).is_file()), None)
    return RunFacts(name or folder.resolve().name, folder, report, recipe, keys, poses, model)


def _poses(folder: Path) -> tuple[tuple[tuple[str, float], ...], Floats]:
    keys: list[tuple[str, float]] = []
    poses = [np.zeros((0, 4, 4))]
    for path in sorted(folder.glob("poses*.tum")):
        trajectory = registry.load("readers", "tum_poses")().open(path).trajectory
        keys += [(path.stem, float(stamp)) for stamp in trajectory.stamps_s]
        poses.append(trajectory.world_from_cam)
    return tuple(keys), np.concatenate(poses)


def compare(first: Path, second: Path) -> Comparison:
    """The runs of two folders, the second laid onto the first. Raises `WorkspaceError`."""
    same = first.resolve().name == second.resolve().name
    a, b = read_facts(first, str(first) if same else ""), read_facts(second, str(second) if same else "")
    row_in_b = {key: row for row, key in enumerate(b.keys)} if _may_share(a, b) else {}
    rows = np.array([(row, row_in_b[key]) for row, key in enumerate(a.keys) if key in row_in_b], int).reshape(-1, 2)
    a_poses, b_poses = a.world_from_cam[rows[:, 0]], b.world_from_cam[rows[:, 1]]
    if len(rows) < FEWEST_SHARED:
        return Comparison(a, b, a_poses[:0], b_poses[:0], np.eye(4), np.zeros(0))
    laid = absolute_error(b_poses, a_poses)
    a_from_b = laid.aligned[0] @ se3.inverse(b_poses[0])
    return Comparison(a, b, a_poses, laid.aligned, a_from_b, laid.per_frame_m)


def _may_share(a: RunFacts, b: RunFacts) -> bool:
    """Whether equal stamps mean equal frames: a clock's do; numbers of frames in sources alike in name or length."""
    if all(is_clock(np.array([stamp for _, stamp in run.keys])) for run in (a, b)):
        return True
    return any(a.report["source"].get(what) == b.report["source"].get(what) for what in ("name", "frames"))


def tables(comparison: Comparison) -> tuple[Table, ...]:
    """What was measured of both runs, and the options in which their recipes differ."""
    header = ("what", comparison.a.name, comparison.b.name, "B against A")
    measured = Table("Measured", header, tuple(_measured(comparison)))
    options = tuple(_changed_options(comparison.a.recipe, comparison.b.recipe))
    names = ("option", comparison.a.name, comparison.b.name)
    changed = Table("Options that differ", names, options, "" if options else "None: the recipes are the same.", 3)
    return measured, changed


def _measured(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    a, b = comparison.a.report, comparison.b.report
    floor_m = floor_of(*(run.world_from_cam[:, :3, 3] for run in (comparison.a, comparison.b)))
    yield "frames", str(a["source"]["frames"]), str(b["source"]["frames"]), ""
    for label, getter, is_length in _MEASURES:
        values = [getter(report) for report in (a, b)]
        if any(value is not None for value in values):
            floor = floor_m if is_length else 0.0
            cells = (_value(value, is_length, floor) for value in values)
            yield label, *cells, _change(values[0], values[1], floor)
    if len(comparison.apart_m):
        apart = comparison.apart_m
        yield "poses apart, mean of the shared frames", "", _apart(float(np.nanmean(apart))), ""
        yield "poses apart, largest", "", _apart(float(np.nanmax(apart))), ""


def _row(report: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    return next((row for row in report.get("trajectories", ()) if row["name"] == name), {})


def _after(report: Mapping[str, Any]) -> str:
    return str(report["verdict"]["after"])


def _score(kind: str, what: str) -> Any:
    def get(report: Mapping[str, Any]) -> float | None:
        graphs = (report.get("scores") or {}).get("graphs", {})
        found: float | None = graphs.get(kind, {}).get("poses", {}).get(_after(report), {}).get(what)
        return found

    return get


def _total(what: str) -> Any:
    return lambda report: sum(stage[what] or 0.0 for stage in report.get("stages", ())) or None


_MEASURES: tuple[tuple[str, Any, bool], ...] = (
    ("error of the trajectory (ATE)", lambda report: _row(report, _after(report)).get("ate_rmse_m"), True),
    ("… of the odometry", lambda report: _row(report, "odometry").get("ate_rmse_m"), True),
    ("error from frame to frame (RPE)", lambda report: _row(report, _after(report)).get("rpe_translation_m"), True),
    *((f"score, {name}", _score(kind, "score"), False) for kind, name in GRAPH_NAMES.items()),
    *((f"distance d, {name}", _score(kind, "distance_m"), True) for kind, name in GRAPH_NAMES.items()),
    ("edges", lambda report: (report.get("graph") or {}).get("edges"), False),
    ("edges ignored by the solver", lambda report: (report.get("graph") or {}).get("edges_ignored"), False),
    ("pairs rejected", lambda report: sum(((report.get("graph") or {}).get("rejected") or {}).values()), False),
    ("connected parts", lambda report: len((report.get("graph") or {}).get("components") or []) or None, False),
    ("time, s", _total("wall_s"), False),
    ("CPU time, s", _total("cpu_s"), False),
    ("peak memory, MB", lambda r: max((s["peak_mb"] or 0.0 for s in r.get("stages", ())), default=None), False),
)  # fmt: skip


def _value(value: float | None, is_length: bool, floor: float) -> str:
    if value is None:
        return "–"
    return length(value, floor_m=floor) if is_length else f"{value:.4g}" if isinstance(value, float) else str(value)


def _apart(metres: float) -> str:
    return "0" if metres < NOTHING_M else length(metres)


def _change(a: float | None, b: float | None, floor: float) -> str:
    if a is None or b is None:
        return ""
    if not sign_of(a, b, max(SAME * abs(a), floor)):
        return "same"
    return percent((b - a) / a) if a > floor else ""


def _changed_options(a: Any, b: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Options that differ; of two stages, which have options of their own, the names."""
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        a, b = ({str(number): each for number, each in enumerate(one, start=1)} for one in (a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping) and a.get("stage") == b.get("stage"):
        for name in dict.fromkeys((*a, *b)):
            if f"{key}{name}" != "description":
                yield from _changed_options(a.get(name), b.get(name), f"{key}.{name}" if key else str(name))
    elif a != b:
        yield key, _named(a), _named(b)


def _named(value: Any) -> str:
    """An option's value in a cell: of a stage its name."""
    if isinstance(value, Mapping) and "stage" in value:
        return str(value["stage"])
    return ", ".join(map(_named, value)) if isinstance(value, list) else "–" if value is None else str(value)
