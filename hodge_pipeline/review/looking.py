"""The pair of clouds that is looked at closely: their poses, and which of their points are shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.review.adding import Candidate
from hodge_pipeline.review.session import Session
from hodge_pipeline.types import Bools, Floats, Floats32, PointCloud

APART = 1.15
"""Distance of clouds side by side, in widths of the first."""
CUT_SHARE = 0.04
"""Half the thickness of a cut, as a share of the size of what is cut."""
EXTENT = 90
"""Percentile of the distances from a cloud's middle that is its size: few points lie far out."""


@dataclass(frozen=True)
class Shown:
    """Two clouds in the world, as the scene draws them.

    - `i`, `j`: vertex rows; `world_from_i`, and of the second cloud `world_from_j` by the edge and `solved_from_j`
      (world_from_j too) by the solution, at which a `share` of its points is drawn.
    - `middle (3,)`, `size_m`: of the first cloud in the world, or of both side by side.
    - `mode`: one of `session.MODES`; `cut`: the height of a cut above the middle, in sizes; None: whole.
    """

    i: int
    j: int
    world_from_i: Floats
    world_from_j: Floats
    solved_from_j: Floats
    share: float
    middle: Floats
    size_m: float
    mode: str
    cut: float | None = None
    candidate: Candidate | None = None

    @property
    def wants_points(self) -> bool:
        """Whether a click picks a point."""
        return self.candidate is not None and self.mode == "apart"

    @property
    def is_placed(self) -> bool:
        """Whether the second cloud is moved by hand."""
        return self.candidate is not None and self.mode == "place"

    @property
    def next_is_first(self) -> bool:
        """Whether the next click is in the first cloud."""
        return self.candidate is None or len(self.candidate.points_i) == len(self.candidate.points_j)

    def picks(self) -> Floats:
        """The points clicked (N, 3), in the world."""
        if self.candidate is None or not self.wants_points:
            return np.zeros((0, 3))
        first = np.reshape(self.candidate.points_i, (-1, 3))
        second = np.reshape(self.candidate.points_j, (-1, 3))
        return np.concatenate([se3.transform(self.world_from_i, first), se3.transform(self.world_from_j, second)])

    def kept(self, points: Floats32, world_from_cam: Floats, up: Floats) -> Bools:
        """Which points (N, 3) of a cloud at a pose lie in the cut across `up`."""
        if self.cut is None:
            return np.ones(len(points), bool)
        heights = (se3.transform(world_from_cam, np.asarray(points, float)) - self.middle) @ up
        return np.asarray(np.abs(heights - self.cut * self.size_m) <= CUT_SHARE * self.size_m)


def shown_pair(session: Session, flip: bool) -> Shown | None:
    """The candidate or selected edge as it is looked at; None: the whole scene. `flip`: a blink shows the solution."""
    look, clouds = session.look, session.subject.clouds
    if look.mode == "all" or clouds is None:
        return None
    poses = session.settled.world_from_cam
    if session.candidate is not None:
        i, j, motion = session.candidate.i, session.candidate.j, session.candidate.motion
    elif look.selected >= 0:
        graph = session.table.graph
        (i, j), motion = graph.edges[look.selected].tolist(), graph.i_from_j[look.selected]
    else:
        return None
    middle, size_m = extent(clouds[i])
    share = {"solution": 1.0, "blink": float(flip), "between": look.share}.get(look.mode, 0.0)
    if look.mode == "apart":
        motion = np.eye(4)
        motion[0, 3] = APART * 2 * size_m
        middle, size_m = middle + [APART * size_m, 0, 0], 2 * size_m
    world = se3.transform(poses[i], middle[None])[0]
    by_edge = poses[i] @ motion
    return Shown(i, j, poses[i], by_edge, poses[j], share, world, size_m, look.mode, look.cut, session.candidate)


def extent(cloud: PointCloud) -> tuple[Floats, float]:
    """The middle (3,) of a cloud in its camera's axes and its size, at least a millimetre."""
    middle, size_m = ball(np.asarray(cloud.points_in_cam, float))
    return middle, max(size_m, 1e-3)


def ball(points: Floats) -> tuple[Floats, float]:
    """The median (3,) of points (N, 3) and the distance within which `EXTENT` per cent lie; 1 where that is 0."""
    if not len(points):
        return np.zeros(3), 1.0
    middle = np.median(points, axis=0)
    return middle, float(np.percentile(np.linalg.norm(points - middle, axis=1), EXTENT)) or 1.0
