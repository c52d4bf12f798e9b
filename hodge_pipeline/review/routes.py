"""The routes of a review's page: what it can ask for and do, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from hodge_pipeline.diagnosis.result import VERDICTS
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import pair_names
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.edge_pictures import edge_pictures
from hodge_pipeline.review.front import Answer, Route, Site
from hodge_pipeline.review.keeping import save
from hodge_pipeline.review.listing import Query, describe, list_edges, state
from hodge_pipeline.review.session import MODES, Session
from hodge_pipeline.rounds.suggestions import suggest_pairs
from hodge_pipeline.stages import Advance
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.notes import Note
from hodge_pipeline.uses.recipe_run import solve_again

FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
}
QUERY = TypeAdapter(Query)
Asked = dict[str, Any]
"""The parameters of a request, not checked yet."""
PICTURES_KEPT = 8
"""Edges whose pictures are kept, 150 kB each."""


def site(session: Session, viewer: Path | None = None) -> Site:
    """The site of a session; `viewer` is the Unix socket of its 3-D viewer."""
    routes: dict[tuple[str, str], Route] = {("GET", name): _file(*found) for name, found in FILES.items()}
    routes |= {("GET", name): route for name, route in _views(session).items()}
    routes |= {("POST", name): _then_state(session, action) for name, action in _actions(session).items()}

    def wait(version: int, seconds: float) -> tuple[int, dict[str, Any]]:
        with session.changed:
            session.changed.wait_for(lambda: session.version != version, timeout=seconds)
            return session.version, state(session)

    return Site(routes, wait, viewer)


def _file(name: str, content_type: str) -> Route:
    with as_file(files("hodge_pipeline.review").joinpath("page", name)) as page:
        body = read_input(page)
    return lambda _: Answer(body, content_type)


def _then_state(session: Session, action: Callable[[Asked], None]) -> Route:
    """A route that does this and answers with the state."""

    def route(asked: Asked) -> Answer:
        action(asked)
        return Answer.json({"state": state(session)})

    return route


def _views(session: Session) -> Mapping[str, Route]:
    """What a page can ask for, by GET."""
    pictures = PictureCache(session)

    def edge(asked: Asked) -> Answer:
        row = _whole(asked, "row")
        titles = [{"title": plot.title, "caption": plot.caption} for plot in pictures.of(row)]
        return Answer.json({**describe(session, row), "pictures": titles})

    def picture(asked: Asked) -> Answer:
        plots, number = pictures.of(_whole(asked, "row")), _whole(asked, "number")
        if not 0 <= number < len(plots):
            raise GraphError("there is no such picture")
        return Answer(plots[number].image, plots[number].media_type)

    def log(_: Asked) -> Answer:
        body = read_input(session.subject.log) if session.subject.log.exists() else b""
        return Answer(body, "text/csv; charset=utf-8", session.subject.log.name)

    return {
        "state": lambda _: _opened(session),
        "edges": lambda asked: Answer.json(list_edges(session, _query(asked))),
        "edge": edge,
        "picture": picture,
        "log": lambda _: Answer.json(session.decisions.lines()),
        "log.csv": log,
        "suggestions": lambda _: Answer.json(suggestions(session)),
    }


def _opened(session: Session) -> Answer:
    """The state for a page that was just opened: another program may have changed the edits before."""
    session.refresh()
    return Answer.json(state(session))


def _actions(session: Session) -> Mapping[str, Callable[[Asked], None]]:
    """What a page can do, by POST."""
    return {
        "decide": lambda asked: session.decide(
            _whole(asked, "revision"), str(asked.get("verb")), _rows(asked), _note(asked)
        ),
        "wrong": lambda asked: session.disable_wrong(_whole(asked, "revision"), _note(asked)),
        "undo": lambda asked: session.undo(_whole(asked, "revision"), _note(asked)),
        "redo": lambda asked: session.redo(_whole(asked, "revision"), _note(asked)),
        "accept": lambda asked: session.accept(_whole(asked, "revision"), _note(asked)),
        "select": lambda asked: session.select(_whole(asked, "row")),
        "look": lambda asked: session.show(**_look(asked)),
        "pick": lambda asked: session.pick(_frames(session, asked)),
        "register": lambda _: session.register(),
        "finish": lambda _: finish(session),
    }


def finish(session: Session) -> None:
    """Solve and fuse a run again with its decisions, or write a graph or a model, in the background."""
    subject = session.subject

    def fuse() -> None:
        session.quick.wait()
        solve_again(subject.path, watcher=_StageMessages(session))
        session.reopen(subject.path)
        session.say("solved and fused: this is the run as it is now")

    def write() -> None:
        path, told = save(session)
        session.say(f"written: {path} ({told})")

    session.slow.put("fusing" if subject.is_run else "writing", fuse if subject.is_run else write)
    session.bump()


class _StageMessages:
    """A watcher that tells the pages which stage runs."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """Tell the stage's title; its progress is not shown."""
        self._session.say(f"hodge solve: {title}")
        return nullcontext(lambda *_: None)

    def note(self, note: Note) -> None:
        """Nothing: the run's log has it."""


def suggestions(session: Session) -> list[dict[str, Any]]:
    """The pairs that the diagnosis would register next, the most informative first."""
    with session.changed:
        judged, table = session.judged, session.table
    if judged is None:
        return []
    graph = table.graph.select(judged.rows)
    found = suggest_pairs(graph, judged.diagnosis, tried=table.graph.edges)
    names = pair_names(graph.vertex_ids, found.pairs)
    rows = zip(names, found.pairs.tolist(), found.score.tolist(), found.reason.tolist(), strict=True)
    return [{"pair": name, "frames": pair, "gain": round(score, 3), "reason": why} for name, pair, score, why in rows]


def _whole(asked: Asked, key: str) -> int:
    """The whole number of this name. Raises `GraphError` where it is none."""
    try:
        return int(asked[key])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise GraphError(f"{key}: expected a whole number, got {asked.get(key)!r}") from None


def _number(asked: Asked, key: str) -> float:
    """The finite number of this name. Raises `GraphError` where it is none."""
    try:
        value = float(asked[key])
    except (TypeError, ValueError, OverflowError):
        value = np.nan
    if not np.isfinite(value):
        raise GraphError(f"{key}: expected a number, got {asked[key]!r}")
    return value


def _rows(asked: Asked) -> list[int]:
    rows = asked.get("rows")
    if not isinstance(rows, list) or not all(isinstance(row, int) for row in rows):
        raise GraphError("rows: expected a list of rows of edges")
    return rows


def _note(asked: Asked) -> str:
    return str(asked.get("note", ""))


def _query(asked: Asked) -> Query:
    """The query of a request, its verdicts joined by commas. Raises `GraphError` for an unknown or wrong option."""
    verdicts = tuple(word for word in str(asked.get("verdicts", "")).split(",") if word)
    try:
        return QUERY.validate_python({key: value for key, value in asked.items() if value} | {"verdicts": verdicts})
    except ValidationError as error:
        first = error.errors()[0]
        raise GraphError(f"{first['loc'][0]}: {first['msg']}") from None


def _look(asked: Asked) -> dict[str, Any]:
    """The changes of `session.Look` that a request asks for. Raises `GraphError` for values that make no sense."""
    changes: dict[str, Any] = {}
    if "mode" in asked:
        if asked["mode"] not in MODES:
            raise GraphError(f"mode: expected {', '.join(MODES)}")
        changes["mode"] = asked["mode"]
    if "share" in asked:
        changes["share"] = min(max(_number(asked, "share"), 0.0), 1.0)
    if "cut" in asked:
        changes["cut"] = None if asked["cut"] is None else _number(asked, "cut")
    if "verdicts" in asked:
        if not isinstance(asked["verdicts"], list):
            raise GraphError(f"verdicts: expected a list of {', '.join(VERDICTS)}")
        changes["verdicts"] = tuple(map(str, asked["verdicts"]))
    return changes


def _frames(session: Session, asked: Asked) -> list[int]:
    """Vertex rows, given as `rows` or by the ids that the table shows. Raises `GraphError` for an unknown id."""
    if "rows" in asked:
        return [row for row in _rows(asked) if 0 <= row < session.table.graph.vertex_count]
    names: Sequence[Any] = asked.get("frames") or ()
    rows = {name: row for row, name in enumerate(session.table.graph.vertex_ids.astype(str).tolist())}
    for name in names:
        if str(name) not in rows:
            raise GraphError(f"{name}: is no frame: give its id, as the table names it")
    return [rows[str(name)] for name in names]


class PictureCache:
    """The pictures of edges at the present poses, made when they are first asked for; the last few are kept."""

    def __init__(self, session: Session) -> None:
        self._session, self._settled = session, session.settled
        self._made: dict[int, tuple[Picture, ...]] = {}
        self._lock = Lock()

    def of(self, row: int) -> tuple[Picture, ...]:
        """The pictures of an edge; none while nothing is judged. Raises `GraphError` for a row without an edge."""
        with self._session.changed:
            subject, table, settled, judged = (
                self._session.subject, self._session.table, self._session.settled, self._session.judged,
            )  # fmt: skip
        table.check_row(row)
        if judged is None:
            return ()
        with self._lock:
            if settled is not self._settled:
                self._settled, self._made = settled, {}
            if row not in self._made:
                poses = replace(judged.diagnosis, world_from_cam=settled.world_from_cam, piece=settled.component)
                found = edge_pictures(
                    table.graph, poses, np.array([row]), subject.frames, subject.clouds, has_metres=subject.unit == "m"
                )
                # the diagnosis draws at its robust poses
                titled = (
                    (plot, plot.title.replace("robust poses say", "solution says"))
                    for one in found
                    for plot in one.plots
                )
                self._made[row] = tuple(replace(plot, title=title) for plot, title in titled)
                if len(self._made) > PICTURES_KEPT:
                    del self._made[next(iter(self._made))]
            return self._made[row]
