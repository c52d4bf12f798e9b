"""`Recorder`: one method and one part file for each stage of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import graph as graph_log
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.curl import log_complex
from hodge_pipeline.recording.diagnosis import log_diagnosis
from hodge_pipeline.recording.frames import log_clouds, log_frames
from hodge_pipeline.recording.growth import log_growth
from hodge_pipeline.recording.merge import find_parts, merge
from hodge_pipeline.recording.registration import log_registration
from hodge_pipeline.recording.results import log_evaluation, log_model, log_text
from hodge_pipeline.recording.stream import Part, writing
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Model, Solution, ViewGraph

Notes = tuple[str, ...]


class Recorder:
    """Writes the parts of one run's recording into a folder.

    A part depends on its arguments and the options alone, and is replaced as a whole: a resumed run records only what
    it computes again. Outer rounds count from 1; `rounds` says how many there will be, since they share the solver's
    bytes. Each method gives notes of what was thinned or left out.
    `is_scanner`: the poses are those of scanners or robots, x ahead and z up.
    """

    def __init__(
        self,
        folder: Path,
        recording_id: str,
        options: RecordingOptions | None = None,
        rounds: int = 1,
        *,
        is_scanner: bool = False,
    ) -> None:
        self.folder, self.recording_id, self.is_scanner = folder, recording_id, is_scanner
        self.options = options or RecordingOptions()
        self.rounds = max(rounds, 1)

    def frames(self, name: str, frames: Sequence[Frame], notes: Sequence[str] = ()) -> Notes:
        """The frames' images as their files hold them, their cameras and names; `notes` are the reader's."""
        sensor = layout.SCANNER if self.is_scanner else ""
        return self._part(0, "frames", sensor, lambda part: log_frames(part, name, frames, notes))

    def clouds(self, frames: Sequence[Frame], clouds: CloudSet) -> Notes:
        """Each frame's down-sampled cloud, in its camera's axes."""
        return self._part(1, "clouds", "", lambda part: log_clouds(part, frames, clouds))

    def poses(self, name: str, world_from_cam: Floats, frames: Sequence[Frame] = ()) -> Notes:
        """A trajectory (N, 4, 4) by its name, such as truth or odometry; NaN where a pose is unknown."""
        return self._part(2, "poses", name, lambda part: graph_log.log_poses(part, name, world_from_cam, frames))

    def registration(self, outer: int, registered: Edges, guesses: Floats, clouds: CloudSet) -> Notes:
        """What registration found for every pair (P,) of an outer round, and why it was rejected, if it was."""
        return self._round(
            2, "registration", outer, lambda part: log_registration(part, outer, registered, guesses, clouds)
        )

    def edges(self, outer: int, graph: ViewGraph, world_from_cam: Floats, rejected: Edges | None = None) -> Notes:
        """The viewing graph of an outer round under the poses it was made with, and the candidates that failed."""
        return self._round(
            0, "edges", outer, lambda part: graph_log.log_edges(part, outer, graph, world_from_cam, rejected)
        )

    def solution(
        self,
        outer: int,
        graph: ViewGraph,
        start: Floats,
        solution: Solution,
        frames: Sequence[Frame] = (),
        *,
        first_iteration: int = 0,
    ) -> Notes:
        """The solve of an outer round from the poses `start`: its film, its scalars, its resulting trajectory.

        `first_iteration` is the number of the start on the iteration timeline: 1 + the iterations of earlier rounds.
        """

        def log(part: Part) -> None:
            graph_log.log_solution(part, outer, graph, start, solution, first_iteration)
            log_complex(part, outer, graph, start, solution)
            graph_log.log_poses(part, layout.round_name(outer), solution.world_from_cam, frames)

        return self._round(1, "solution", outer, log)

    def diagnosis(self, graph: ViewGraph, world_from_cam: Floats, edges: Edges) -> Notes:
        """The edges of a graph by verdict, under the last poses; the label of each says how probable it is, and why."""
        return self._part(890, "diagnosis", "", lambda part: log_diagnosis(part, graph, world_from_cam, edges))

    def model(self, model: Model, clouds: CloudSet | None = None, world_from_cam: Floats | None = None) -> Notes:
        """The fused scene; with the clouds of the frames and their poses also how it grows."""

        def log(part: Part) -> None:
            if clouds is not None and world_from_cam is not None:
                log_growth(part, model, clouds, world_from_cam, self.rounds + 1)
            log_model(part, model)

        return self._part(900, "model", "", log)

    def evaluation(self, frames: Sequence[Frame], per_frame: Mapping[str, Floats], tables: Mapping[str, str]) -> Notes:
        """Scores: series (N,) over the frames such as the ATE in metres, and Markdown tables by title."""
        return self._part(901, "evaluation", "", lambda part: log_evaluation(part, frames, per_frame, tables))

    def text(self, recipe: str, log_lines: Sequence[str]) -> Notes:
        """The resolved recipe as YAML, and the run's log."""
        return self._part(902, "text", "", lambda part: log_text(part, recipe, log_lines, self.rounds + 1))

    def finish(self, out: Path) -> None:
        """All parts of the folder as one file that opens on the story."""
        merge(find_parts(self.folder), out, self.recording_id)

    def _round(self, offset: int, stage: str, outer: int, log: Callable[[Part], None]) -> Notes:
        number = min(10 * outer, 880) + offset  # below that of the diagnosis
        return self._part(number, stage, str(outer), log, slot=outer)

    def _part(self, number: int, stage: str, detail: str, log: Callable[[Part], None], *, slot: int = 0) -> Notes:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / layout.part_name(number, stage, detail)
        with writing(path, self.recording_id) as stream:
            round_bytes = self.options.max_bytes("solver") / self.rounds
            part = Part(stream, self.options, round_bytes, slot, self.is_scanner)
            log(part)
        return tuple(part.notes)
