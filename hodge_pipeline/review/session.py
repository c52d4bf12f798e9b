"""A review: decisions about edges, the poses and verdicts that follow from them, and what is being looked at."""

from __future__ import annotations

import getpass
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Condition
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import SUSPECT, VERDICTS, WRONG
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import ENABLED, REGISTERED, RIGHT, Edit, pair_names, vertex_rows
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.review.adding import Candidate, assessed, register_candidate
from hodge_pipeline.review.decisions import Decisions, LockedError, LogEntry
from hodge_pipeline.review.jobs import Jobs
from hodge_pipeline.review.settle import Judged, Settled, Settler, Table, judge
from hodge_pipeline.review.subject import Subject, open_for_review
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import DISABLED

_SWITCHES = {"disable": DISABLED, "enable": ENABLED, "right": RIGHT}
"""What each decision on an edge makes of it."""
CANDIDATE_MODES = ("apart", "place")
MODES = ("all", "edge", "solution", "blink", "between", *CANDIDATE_MODES)
"""How the scene shows edges; see `Look`."""


@dataclass(frozen=True)
class Look:
    """What the scene shows.

    - `selected`: the row of an edge, −1: none; `picked`: vertex rows to be joined.
    - `mode`: `all` shows the whole scene, the others the two clouds of the edge or candidate alone. The second cloud
      lies at the pose of the edge (`edge`), of the solution, of both by turns (`blink`), or with a `share` of its
      points as the solution has them (`between`). Of a candidate also side by side to click points (`apart`), or with
      handles that move it (`place`).
    - `cut`: a cut through the clouds at this share of their size above their middle; None: whole.
    - `verdicts`: those whose edges are drawn; `home`: how often the overview was asked for again.
    """

    selected: int = -1
    mode: str = "all"
    share: float = 0.0
    cut: float | None = None
    picked: tuple[int, ...] = ()
    verdicts: tuple[str, ...] = (WRONG, SUSPECT)
    home: int = 0


class Session:
    """The state that every page of a review shows; `version` grows with each visible change.

    Two threads work for it: `quick` solves after a decision, `slow` judges, registers and writes. Fields change
    under the condition `changed`.
    """

    def __init__(self, subject: Subject, *, who: str | None = None, now: Callable[[], str] | None = None) -> None:
        self.changed = Condition()
        self.version = 0
        self.message = ""
        self.look = Look()
        self.candidate: Candidate | None = None
        self._who = getpass.getuser() if who is None else who
        self._now = now or _utc_now
        self.quick = Jobs("settle", self.say)
        self.slow = Jobs("judge", self.say)
        self._open(subject)

    def _open(self, subject: Subject) -> None:
        """Begin with a subject: solve with the decisions it has already, register what they add, judge."""
        folder = subject.path if subject.is_run else None
        self.subject = subject
        self.decisions = Decisions(subject.edits, subject.log, run_folder=folder, locked=subject.locked)
        self.locked = self.decisions.why_locked()
        self._settler = Settler(subject)
        self._adding: list[Candidate] = []
        self.table: Table = self._settler.table
        self.settled: Settled = self._settler.settled
        self.judged: Judged | None = None
        self.first = self.settled
        if ((self.table.weights(self.decisions.history) > 0) != (self.settled.weights > 0)).any():
            self.quick.put("solving", self._solve)
        # Now, before a page can add pairs of its own, and under another name than what a page has registered.
        history = self.decisions.history
        missing = {pair: history.guesses[pair] for pair in self.missing() if pair in history.guesses}
        self.slow.put("registering what was added before", partial(self._register_missing, missing))
        self.slow.put("judging", self._judge)

    def close(self) -> None:
        """End the threads."""
        self.quick.close()
        self.slow.close()

    def wait(self) -> None:
        """Return when poses and verdicts are those of the latest decision."""
        self.quick.wait()
        self.slow.wait()
        self.quick.wait()

    def say(self, message: str) -> None:
        """Show a message on every page."""
        with self.changed:
            self.message = message
            self.bump()

    def bump(self) -> None:
        """Wake everything that shows the state."""
        with self.changed:
            self.version += 1
            self.changed.notify_all()

    def names(self, rows: Ints | Sequence[int]) -> list[str]:
        """The names of edges: `12-87`."""
        graph = self.table.graph
        return pair_names(graph.vertex_ids, graph.edges[np.asarray(rows, np.int64)])

    def decide(self, revision: int, verb: str, rows: Sequence[int], note: str = "") -> None:
        """Disable edges, enable them or mark them right, and solve. Raises as `Decisions.add`, and `GraphError`."""
        count = len(self.table)
        if verb not in _SWITCHES or not rows or not all(0 <= row < count for row in rows):
            raise GraphError(f"{verb}: expected {', '.join(_SWITCHES)} and rows of edges from 0 to {count - 1}")
        pairs = tuple(dict.fromkeys(self.names(rows)))
        switches = self.decisions.history.switches
        if all(switches.get(pair) == _SWITCHES[verb] for pair in pairs):
            raise GraphError(f"{', '.join(pairs)}: {_SWITCHES[verb]} already")
        decision: dict[str, Any] = {verb: pairs}
        self._change(lambda: self.decisions.add(revision, Edit(**decision), self._entry(rows, note)))

    def disable_wrong(self, revision: int, note: str = "") -> None:
        """Disable every edge that counts, is wrong and undecided. Raises as `decide`."""
        with self.changed:
            off = self.table.switches(self.decisions.history) != ""
            rows = np.flatnonzero((self.table.edges.verdict == WRONG) & (self.settled.weights > 0) & ~off)
        if not len(rows):
            raise GraphError("no edge that counts is wrong")
        self.decide(revision, "disable", rows.tolist(), note)

    def undo(self, revision: int, note: str = "") -> None:
        """Undo the latest decision, and solve. Raises as `Decisions.undo`."""
        self._change(lambda: self.decisions.undo(revision, self._entry((), note)))

    def redo(self, revision: int, note: str = "") -> None:
        """Redo the decision that was undone last, and solve. Raises as `Decisions.redo`."""
        self._change(lambda: self.decisions.redo(revision, self._entry((), note)))

    def accept(self, revision: int, note: str = "") -> None:
        """Add the edge that was registered. Raises as `decide`."""
        candidate = self.candidate
        if candidate is None or candidate.found is None:
            raise GraphError("there is no registered pair to add: pick two frames and register them")
        graph = self.table.graph
        (pair,) = pair_names(graph.vertex_ids, np.array([[candidate.i, candidate.j]]))
        guess = (pair, tuple(candidate.found.i_from_j.reshape(-1).tolist()))
        let_in = (pair,) if candidate.rejected else ()
        edit = Edit(register=(pair,), enable=let_in, guesses=(guess,))

        def change() -> None:
            self.decisions.add(revision, edit, self._entry((), note))
            self._adding.append(candidate)
            self.candidate = None

        self._change(change)

    def _change(self, change: Callable[[], None]) -> None:
        """Make a change of the decisions and solve, also where another program's change refused this one."""
        with self.changed:
            before = self.decisions.revision
            try:
                change()
                self.message, self.locked = "", ""
            except LockedError as error:
                self.locked = str(error)
                raise
            finally:
                if self.decisions.revision != before:
                    self.quick.put("solving", self._solve)
                self.bump()

    def _entry(self, rows: Sequence[int], note: str) -> LogEntry:
        """The log entry of a decision about these edges, with the facts of the one least likely to be right."""
        entry = LogEntry(self._who, self._now(), note[:1000])
        if not len(rows):
            return entry
        edges, settled = self.table.edges, self.settled
        worst = min(rows, key=lambda row: np.nan_to_num(edges.probability[row], nan=1.0))
        return replace(
            entry,
            verdict=str(edges.verdict[worst]),
            score=_number(float(edges.probability[worst])),
            residual_m=_number(float(settled.residual_m[worst])),
            residual_deg=_number(float(np.degrees(settled.residual_rad[worst]))),
        )

    def _solve(self) -> None:
        """Solve the latest decisions, publish a preview, then what a check from the edges alone makes of it."""
        with self.changed:
            history, revision, settler = self.decisions.history, self.decisions.revision, self._settler
            adding, self._adding = self._adding, []
        for new in adding:
            assert new.found is not None
            settler.add(new.i, new.j, new.found)
        self._publish(settler, settler.solve(history, revision))
        better = settler.checked(history, revision) if self.decisions.revision == revision else None
        if better is not None:
            self._publish(settler, better)
        self.slow.put("judging", self._judge)

    def _publish(self, settler: Settler, settled: Settled) -> None:
        """Show a result, unless another subject was opened since."""
        with self.changed:
            if settler is self._settler:
                self.settled = settled
                self.table = settler.table = _with_verdicts(settler.table, self.table.edges)
            self.bump()

    def _judge(self) -> None:
        """Diagnose the edges, and show the verdicts unless the table changed since."""
        with self.changed:
            history, table, recipe = self.decisions.history, self.table, self.subject.recipe
        judged = judge(table, history, DiagnosisOptions() if recipe is None else recipe.diagnosis)
        with self.changed:
            if table is self.table:
                if self.judged is None and not np.isin(judged.edges.verdict, self.look.verdicts).any():
                    self.look = replace(self.look, verdicts=VERDICTS)  # an empty page would tell nothing
                self.judged = judged
                self.table = replace(table, edges=judged.edges)
            self.bump()

    def _register_missing(self, guesses: Mapping[str, Floats]) -> None:
        """Register pairs that an earlier review added and no run has solved: only their motions were stored."""
        recipe, clouds = self.subject.recipe, self.subject.clouds
        if recipe is None or clouds is None or not guesses:
            return
        rows = vertex_rows(self.table.graph.vertex_ids, list(guesses)).tolist()
        for guess, (i, j) in zip(guesses.values(), rows, strict=True):
            wanted = Candidate(i, j, guess)
            found = register_candidate(recipe, clouds, wanted)
            with self.changed:
                self._adding.append(replace(wanted, found=found))
        self.quick.put("solving", self._solve)

    def show(self, **changes: Any) -> None:
        """Change fields of `look`; asking for the whole scene while it is shown brings its first view back."""
        with self.changed:
            if changes.get("mode") == self.look.mode == "all":
                changes["home"] = self.look.home + 1
            self.look = replace(self.look, **changes)
            self.bump()

    def select(self, row: int) -> None:
        """Select an edge, −1: none. Raises `GraphError` for a row that is no edge's."""
        if row != -1:
            self.table.check_row(row)
        with self.changed:
            self.candidate = None
            self.look = replace(self.look, mode="edge" if self.look.mode in CANDIDATE_MODES else self.look.mode)
            self.show(selected=row, picked=())

    def pick(self, frames: Sequence[int]) -> None:
        """Pick vertex rows to be joined; the last two become the candidate, its guess by the present poses."""
        with self.changed:
            frames = tuple(dict.fromkeys(frames))[-2:]
            self.candidate = None
            if len(frames) == 2:
                (i, j), poses = sorted(frames), self.settled.world_from_cam
                self.candidate = Candidate(i, j, se3.inverse(poses[i]) @ poses[j])
            self.show(picked=frames, selected=-1)

    def click_point(self, point: Floats) -> None:
        """Add a point (3,) of the candidate's next cloud, in its camera's axes."""
        with self.changed:
            if self.candidate is not None:
                x, y, z = map(float, point)
                try:
                    self.candidate = self.candidate.clicked((x, y, z))
                except GraphError as error:
                    self.message = str(error)
                self.bump()

    def place(self, world_from_j: Floats) -> None:
        """Guess the candidate's motion by the pose (4, 4) that its second cloud was moved to."""
        with self.changed:
            if (now := self.candidate) is not None:
                i_from_j = se3.inverse(self.settled.world_from_cam[now.i]) @ world_from_j
                self.candidate = Candidate(now.i, now.j, i_from_j, "the place it was put at")
                self.bump()

    def register(self) -> None:
        """Register the candidate by the run's own registrar in the background. Raises `GraphError` without a run."""
        subject, wanted = self.subject, self.candidate
        if wanted is None:
            raise GraphError("pick two frames first")
        if subject.recipe is None or subject.clouds is None:
            raise GraphError(f"{subject.path}: is no run whose clouds could be registered: add it where it was made")
        self.slow.put("registering", partial(self._register, subject.recipe, subject.clouds, wanted))
        self.bump()

    def _register(self, recipe: Recipe, clouds: CloudSet, wanted: Candidate) -> None:
        """Register a pair, and show the result unless another candidate was chosen since."""
        found = register_candidate(recipe, clouds, wanted)
        with self.changed:
            if self.candidate is wanted:
                poses = self.settled.world_from_cam
                self.candidate = assessed(recipe, self.table.graph, clouds, poses, wanted, found)
            self.bump()

    def refresh(self) -> None:
        """Take over edits of another program, and whether one uses the folder."""
        with self.changed:
            self.locked = self.decisions.why_locked()
            if self.decisions.refresh():
                self.quick.put("solving", self._solve)
            self.bump()

    def reopen(self, path: Path) -> None:
        """Open the subject again after it was solved elsewhere, and show the whole scene."""
        subject = open_for_review(path)
        with self.changed:
            self._open(subject)
            self.look = Look()
            self.bump()

    def rows_of(self, pair: str) -> list[int]:
        """The rows of the edges that join a pair `a-b`."""
        return list(self.table.rows.get(pair, ()))

    def missing(self) -> list[str]:
        """The pairs `a-b` that decisions register and that are no edges yet."""
        switches = self.decisions.history.switches
        return [pair for pair, switch in switches.items() if switch == REGISTERED and not self.rows_of(pair)]

    @property
    def disabled(self) -> int:
        """How many edges are disabled by hand."""
        return int((self.table.switches(self.decisions.history) == DISABLED).sum())


def _with_verdicts(table: Table, edges: Edges) -> Table:
    """The table with the verdicts of these edges, which are its first rows."""
    rows = np.arange(len(edges))
    columns = {name: getattr(edges, name) for name in ("verdict", "probability", "why")}
    return replace(table, edges=table.edges.put(rows, **columns))


def _number(value: float) -> str:
    """A number of four digits for the log; "" where it is unknown."""
    return f"{value:.4g}" if np.isfinite(value) else ""


def _utc_now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
