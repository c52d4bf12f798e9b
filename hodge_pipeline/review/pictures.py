"""Pictures of the edge that is looked at: its two clouds by the edge and by the solution, its images with matches."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from threading import Lock

import numpy as np

from hodge_pipeline.errors import GraphError
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.edge_pictures import edge_pictures
from hodge_pipeline.review.session import Session

KEPT = 8
"""Edges whose pictures are kept, 150 kB each."""


class Pictures:
    """The pictures of edges at the present poses, made when they are first asked for."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._made: OrderedDict[tuple[int, int, int], tuple[Picture, ...]] = OrderedDict()
        self._lock = Lock()

    def of(self, row: int) -> tuple[Picture, ...]:
        """The pictures of an edge; none where nothing is judged yet. Raises `GraphError` for a row without an edge."""
        with self._session.changed:
            subject, table, settled, judged = (
                self._session.subject, self._session.table, self._session.settled, self._session.judged,
            )  # fmt: skip
        if not 0 <= row < len(table):
            raise GraphError(f"there is no edge {row}: rows go from 0 to {len(table) - 1}")
        if judged is None:
            return ()
        key = id(subject), settled.revision, row
        with self._lock:
            if key not in self._made:
                poses = replace(judged.diagnosis, world_from_cam=settled.world_from_cam, piece=settled.component)
                found = edge_pictures(
                    table.graph, poses, np.array([row]), subject.frames, subject.clouds, has_metres=subject.unit == "m"
                )
                plots = tuple(_told(plot) for one in found for plot in one.plots)
                self._made[key] = plots
                while len(self._made) > KEPT:
                    self._made.popitem(last=False)
            return self._made[key]


def _told(plot: Picture) -> Picture:
    return replace(plot, title=plot.title.replace("robust poses say", "solution says"))
