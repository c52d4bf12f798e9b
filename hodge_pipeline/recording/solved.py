"""Recording of a pose-graph file that `hodge solve` solved."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from hodge_pipeline.recording.recorder import Recorder
from hodge_pipeline.recording.stream import identity_of_poses
from hodge_pipeline.store.workspace import RECORDING_FILE
from hodge_pipeline.types import Floats, Solution, ViewGraph


def record_graph(
    folder: Path,
    name: str,
    graph: ViewGraph | None,
    start: Floats,
    solution: Solution | None,
    sets: Mapping[str, Floats],
    notes: Sequence[str],
    *,
    is_scanner: bool = False,
) -> tuple[str, ...]:
    """Write `recording.rrd`: the graph as it was, the film of the solve, the edges under its result, further poses.

    The sets of poses alone where nothing was solved; `is_scanner` as of a `Recorder`. What was left out, in words.
    """
    result = start if solution is None else solution.world_from_cam
    with tempfile.TemporaryDirectory(dir=folder, prefix=".recording-") as parts:
        recorder = Recorder(Path(parts), identity_of_poses(result), is_scanner=is_scanner)
        left_out = [*recorder.frames(name, (), tuple(notes))]
        left_out += [note for label, poses in sets.items() for note in recorder.poses(label, poses)]
        if graph is not None and solution is not None:
            left_out += [*recorder.edges(1, graph, start), *recorder.solution(1, graph, start, solution)]
        recorder.finish(folder / RECORDING_FILE)
    return tuple(left_out)
