"""Diagnose a run or a pose-graph file: verdicts, advice, commands to type and pairs to register next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import WRONG, Diagnosis
from hodge_pipeline.pairs.edits import joining, pair_names, read_history
from hodge_pipeline.recipe.round_options import SuggestionOptions
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.report.advice import advice, ranked
from hodge_pipeline.report.diagnosis_page import sentence
from hodge_pipeline.report.energy import EnergyRow, energy_rows
from hodge_pipeline.report.suspicions import moved_without
from hodge_pipeline.rounds.suggestions import Suggestions, suggest_pairs
from hodge_pipeline.solvers.backbone.trust import AUTO
from hodge_pipeline.sources.frame_facts import listed
from hodge_pipeline.store.edge_table import read_edges
from hodge_pipeline.store.workspace import EDGES_FILE, EDITS_FILE, SOLVED_FILE, is_run_folder
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Ints, ViewGraph
from hodge_pipeline.types.edges import DISABLED, IGNORED, USED
from hodge_pipeline.types.text import command, in_unit

if TYPE_CHECKING:
    from hodge_pipeline.report.contents import Report
    from hodge_pipeline.run_folder import Run

COMMANDED_PAIRS = 6
"""Suggested pairs at most that a command to type registers."""
CONTRADICTED = 6.2
"""Past so many sigma, which one of 10⁶ right edges reaches (χ² of 6 numbers), given poses contradict an edge …"""
CONTRADICTED_EXCESS = 3.0
"""… if also by so many times the worst of the kept edges at the robust poses. Good COLMAP models stay within 1.7 times,
those with one image off, or noise of 2 % of the extent, reach 20 to 4000.
"""
COMMANDED_EDGES = 3
"""Edges at most that a command to type disables: more are left to `--robust`."""


@dataclass(frozen=True)
class DiagnosisSubject:
    """A graph to judge.

    - `edges (E,)`: the table of its edges, with those that are disabled by hand.
    - `given (V, 4, 4)`: the poses of a model that has frames; None of a run, or of a graph, whose poses are a start.
    - `tried (P, 2)`: pairs that were registered and rejected; `frames`, `clouds`: of a run alone.
    - `harmless`: why its wrong edges need not be disabled, "" where they need.
    - `has_metres`: False where lengths are in a unit of their own.
    """

    path: Path
    name: str
    graph: ViewGraph
    edges: Edges
    given: Floats | None = None
    is_run: bool = False
    options: DiagnosisOptions = field(default_factory=DiagnosisOptions)
    suggestions: SuggestionOptions = field(default_factory=SuggestionOptions)
    tried: Ints | None = None
    frames: Sequence[Frame] = ()
    clouds: CloudSet | None = None
    notes: tuple[str, ...] = ()
    harmless: str = ""
    has_metres: bool = True

    @property
    def disabled(self) -> Bools:
        """The edges (E,) that are disabled by hand."""
        return np.asarray(self.edges.status == DISABLED)

    @property
    def left_out(self) -> Bools:
        """The edges (E,) of a solved file, not of a run, that its robust solve left out."""
        return np.asarray((self.edges.status == IGNORED) & (not self.is_run))


def open_subject(path: Path, trust: str | None = None) -> DiagnosisSubject:
    """The graph of a run's last round, or of a pose-graph file. Raises `HodgeError` where there is none.

    `trust`: which edges are a backbone, in place of what the run's recipe says.
    """
    if is_run_folder(path):
        from hodge_pipeline.run_folder import Run

        subject = _run_subject(path, Run.load(path))
    else:
        subject = _file_subject(path)
    if trust is None:
        return subject
    return replace(subject, options=replace(subject.options, trust=trust), harmless="")


def _file_subject(path: Path) -> DiagnosisSubject:
    """A pose graph, with the edges that were ignored where the path is the folder of a solve."""
    source = read_graph(path)
    assert source.graph is not None
    name = path.stem if path.is_file() else path.name
    edges = Edges.measured(source.graph)
    if (path / SOLVED_FILE).is_file() and len(solved := read_edges(path / EDGES_FILE)[0]) == len(edges):
        edges = edges.put(solved.status == IGNORED, status=IGNORED)
    of_model = source.frames and all(frame.true_world_from_cam is None for frame in source.frames)
    given = source.trajectory.world_from_cam if of_model and source.trajectory is not None else None
    edges = _edited(path, source.graph, edges)
    return DiagnosisSubject(path, name, source.graph, edges, given, notes=source.notes, has_metres=source.in_metres)


def _run_subject(path: Path, run: Run) -> DiagnosisSubject:
    """The last round of a run. Raises `WorkspaceError` where it has not ended."""
    report = run.report
    last, recipe = run.result, run.recipe
    edges = _edited(path, last.graph, last.graph_edges)
    as_solved = np.array_equal(edges.status, last.graph_edges.status)
    frames, notes = run.key_frames_with_images()
    return DiagnosisSubject(
        path,
        path.resolve().name,
        last.graph,
        edges,
        is_run=True,
        options=recipe.diagnosis,
        suggestions=recipe.suggestions,
        tried=last.rejected.pairs,
        frames=frames,
        clouds=run.clouds,
        notes=tuple(map(str, (*run.options_left_out, *notes))),
        harmless=_harmless(report) if as_solved else "",
    )


def _harmless(report: Report) -> str:
    """Why the wrong edges of a run do no harm; "" where they move poses, or the run did not measure that."""
    if report.wrong_edges is None or report.wrong_edges.matters(report.scale):
        return ""
    moved = moved_without(report.wrong_edges, report)
    return f"Without the wrong edges no pose moves by more than {moved}: nothing to do."


def _edited(path: Path, graph: ViewGraph, edges: Edges) -> Edges:
    """The edges with those disabled that the present edits in the folder disable, and no others."""
    disabled = read_history(path / EDITS_FILE).disabled if path.is_dir() else ()
    edges = edges.put(edges.status == DISABLED, status=USED)
    return edges.put(joining(graph.vertex_ids, graph.edges, *disabled), status=DISABLED)


@dataclass(frozen=True)
class Diagnosed:
    """A subject with its diagnosis, the advice on each edge (E,), the energy of its parts, and what to do next."""

    subject: DiagnosisSubject
    diagnosis: Diagnosis
    advice: tuple[str, ...]
    energy: tuple[EnergyRow, ...]
    commands: tuple[str, ...]
    notes: tuple[str, ...]
    suggestions: Suggestions

    @property
    def sentence(self) -> str:
        """The verdict on the whole graph in one sentence."""
        return in_unit(sentence(self.subject.graph, self.diagnosis), self.subject.has_metres)

    @property
    def rows(self) -> Ints:
        """The rows (E,) of the edges, the worst first."""
        return ranked(self.diagnosis)


def diagnose_subject(subject: DiagnosisSubject) -> Diagnosed:
    """The verdicts on every edge, and what follows from them."""
    found = diagnose(subject.graph, subject.options)
    reason, told = (tuple(in_unit(each, subject.has_metres) for each in lines) for lines in (found.reason, found.notes))
    found = replace(found, reason=reason, notes=told)
    pieces = int(found.piece.max(initial=-1)) + 1
    apart = f"poses.tum holds {pieces} pieces, each in a frame of its own: nothing sound connects them"
    energy, complaints = energy_rows(subject.graph, found.world_from_cam, found.piece, found.kept)
    harmless = (subject.harmless,) if subject.harmless and (found.verdict == WRONG).any() else ()
    gone = int(((found.verdict == WRONG) & subject.left_out).sum())
    notes = (
        *harmless,
        *((f"The robust solve left {gone} of the wrong edges out already.",) if gone else ()),
        *_contradicted(subject, found),
        *((apart,) if pieces > 1 else ()),
        *subject.notes,
        *found.notes,
        *_side_by_side(subject, found),
        *complaints,
    )
    suggestions = suggest_pairs(subject.graph, found, overlapping=_overlapping(subject, found), tried=subject.tried)
    commands = _commands(subject, found, suggestions)
    told = advice(found, subject.disabled, subject.left_out | bool(harmless))
    return Diagnosed(subject, found, told, energy, commands, notes, suggestions)


def _contradicted(subject: DiagnosisSubject, found: Diagnosis) -> tuple[str, ...]:
    """A note where given poses contradict kept edges, with the vertices most of whose edges those are."""
    graph = subject.graph.select(found.kept)
    if subject.given is None or len(subject.given) != graph.vertex_count or not graph.edge_count:
        return ()
    edges, information = graph.edges, found.information[found.kept]

    def sigmas(world_from_cam: Floats) -> Floats:
        i_from_j = se3.inverse(world_from_cam[edges[:, 0]]) @ world_from_cam[edges[:, 1]]
        off = se3.log(se3.inverse(graph.i_from_j) @ i_from_j)
        return np.asarray(np.sqrt(np.einsum("ea,eab,eb->e", off, information, off)))

    off = sigmas(subject.given) > CONTRADICTED_EXCESS * max(CONTRADICTED, sigmas(found.world_from_cam).max())
    if not off.any():
        return ()
    of_each, off_of_each = (np.bincount(rows.ravel(), minlength=len(subject.given)) for rows in (edges, edges[off]))
    named = graph.vertex_ids[2 * off_of_each > of_each].tolist()
    whose = f", most of those of {listed(named)}" if named else ""
    return (
        f"the poses given contradict {off.sum()} of the {len(edges)} edges kept{whose}: these poses are off, "
        "not the edges: refine the model",
    )


def _overlapping(subject: DiagnosisSubject, found: Diagnosis) -> Ints | None:
    """The pairs (P, 2) of a run whose frames overlap at the robust poses; None without frames and clouds."""
    if subject.clouds is None or not subject.frames:
        return None
    from hodge_pipeline.start.unordered.folds import laid_apart

    poses = laid_apart(found.piece, found.world_from_cam, subject.clouds)
    return subject.suggestions.among.propose(subject.frames, subject.clouds, poses).pairs


def _beside_kept(graph: ViewGraph, found: Diagnosis) -> Bools:
    """Wrong edges (E,) parallel to a kept one: disabling their pair of names would take out both."""
    low, high = np.sort(graph.edges, axis=1).T
    pair = low * graph.vertex_count + high
    return np.asarray((found.verdict == WRONG) & np.isin(pair, pair[found.kept]))


def _side_by_side(subject: DiagnosisSubject, found: Diagnosis) -> tuple[str, ...]:
    """A note on wrong edges parallel to kept ones, where there are any."""
    rows = np.flatnonzero(_beside_kept(subject.graph, found))
    if not len(rows):
        return ()
    named = ", ".join(dict.fromkeys(pair_names(subject.graph.vertex_ids, subject.graph.edges[rows])))
    return (
        f"beside a wrong edge a right one joins the same two views ({named}): disabling the pair would take out both, "
        "a robust solve takes out the wrong one alone",
    )


def _commands(subject: DiagnosisSubject, found: Diagnosis, suggestions: Suggestions) -> tuple[str, ...]:
    """What to type next: disable wrong edges, or else register pairs, and solve; nothing where all is well."""
    used = (found.verdict == WRONG) & ~subject.disabled & ~subject.left_out
    beside = _beside_kept(subject.graph, found)
    meant = used & ~beside & (not subject.harmless)
    rows = ranked(found)
    rows = rows[meant[rows]]
    wrong = pair_names(subject.graph.vertex_ids, subject.graph.edges[rows])
    if not subject.is_run:
        trust = ("--trust", subject.options.trust) if subject.options.trust != AUTO else ()
        left_out = len(wrong) > COMMANDED_EDGES or bool((used & beside).any())
        off = ("--robust", *trust) if left_out else [word for pair in wrong for word in ("--disable", pair)]
        return (command("hodge", "solve", subject.path, "--out", "solved.g2o", *off),) if off else ()
    useful = suggestions.pairs[suggestions.score >= subject.suggestions.min_gain][:COMMANDED_PAIRS]
    if not wrong and not len(useful):
        return ()
    by_word = np.array_equal(meant, (subject.edges.verdict == WRONG) & ~subject.disabled)
    edit = "--disable", WRONG if by_word else ",".join(wrong)
    if not wrong:
        edit = "--register", ",".join(pair_names(subject.graph.vertex_ids, useful))
    return command("hodge", "edit", subject.path, *edit), command("hodge", "solve", subject.path)
