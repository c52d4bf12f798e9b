"""The two clouds of an edge in the scene: faded between two poses, cut, or moved by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.review.looking import Shown, extent
from hodge_pipeline.review.session import Session
from hodge_pipeline.types import CloudSet, Floats, Floats32

FIRST, SECOND, SOLVED, PICKED = (0, 114, 178), (230, 120, 0), (0, 158, 115), (190, 0, 190)
"""Colours of the first cloud; of the second at the edge's pose and at the solution's; of clicked points."""
MOST_POINTS = 200_000
"""Points drawn of each cloud."""
SLICES = 10
"""Random parts of a cloud: a fade shows and hides them, and sends nothing again."""
POINT_SHARE = 0.5
"""Size of a point, as a share of the distance between points spread evenly over a square of the cloud's size."""
LARGEST_POINT = 0.015
"""Size of a point at most, as a share of the cloud's."""
PICK_SHARE = 0.02
"""Size of a clicked point, as a share of the scene's."""
NAMES = ("first", "second", "solved")


class Closeup:
    """Draws the pair that `shown_pair` gives; clouds that are drawn already are moved, shown and hidden, not sent."""

    def __init__(self, session: Session, server: Any) -> None:
        self._session, self._scene = session, server.scene
        self._drawn: dict[str, tuple[Any, ...]] = {}
        self._parts: dict[str, list[Any]] = {}
        self._nodes: dict[str, Any] = {}
        self._scene.add_frame("/pair", show_axes=False)

    def draw(self, pair: Shown | None, clouds: CloudSet | None, up: Floats, size: float) -> None:
        """Show the two clouds, or nothing where there are none; `up (3,)` and `size` are the scene's."""
        if pair is None or clouds is None:
            for name in (*NAMES, "picks"):
                self._remove(name)
            return
        fading = round(pair.share * SLICES)
        poses = pair.world_from_i, pair.world_from_j, pair.solved_from_j
        shown = range(SLICES), range(fading, SLICES), range(fading)
        for name, row, colour, pose, parts in zip(
            NAMES, (pair.i, pair.j, pair.j), (FIRST, SECOND, SOLVED), poses, shown, strict=True
        ):
            self._cloud(name, pair, clouds, row, colour, pose, up)
            for number, part in enumerate(self._parts[name]):
                part.visible = number in parts
        self._picks(pair.picks(), size)

    def _cloud(self, name: str, pair: Shown, clouds: CloudSet, row: int, colour: Any, pose: Floats, up: Floats) -> None:
        """A node at the middle of a cloud at a pose, with its points in slices; sent only if these points changed."""
        middle, size_m = extent(clouds[row])
        placing = pair.is_placed and name == "second"
        cut = () if pair.cut is None else (pair.cut, *pose.reshape(-1))
        key = (row, placing, *cut)
        if self._drawn.get(name) != key:
            self._remove(name)
            self._drawn[name] = key
            self._nodes[name] = self._gizmo(size_m) if placing else self._scene.add_frame(_at(name), show_axes=False)
            points = _some(clouds, row)
            points = points[pair.kept(points, pose, up)] - middle.astype(np.float32)
            self._parts[name] = [
                self._scene.add_point_cloud(
                    f"{_at(name)}/{number}", points[number::SLICES], colour, precision="float32",
                    point_size=size_m * min(POINT_SHARE / max(len(points), 1) ** 0.5, LARGEST_POINT),
                )
                for number in range(SLICES)
            ]  # fmt: skip
        here = pose @ se3.from_parts(np.eye(3), middle)
        self._nodes[name].wxyz, self._nodes[name].position = placed(here)

    def _gizmo(self, size_m: float) -> Any:
        """Handles that move the second cloud; the pose at which they are let go becomes the candidate's guess."""
        gizmo = self._scene.add_transform_controls(_at("second"), scale=size_m, depth_test=False)

        def moved(event: Any) -> None:
            candidate, clouds = self._session.candidate, self._session.subject.clouds
            if event.phase == "end" and candidate is not None and clouds is not None:
                here = se3.from_quat_xyzw(np.array(gizmo.position), np.array(gizmo.wxyz)[[1, 2, 3, 0]])
                self._session.place(here @ se3.from_parts(np.eye(3), -extent(clouds[candidate.j])[0]))

        gizmo.on_update(moved)
        return gizmo

    def _picks(self, picks: Floats, size: float) -> None:
        """The clicked points (N, 3) in the world; nothing is sent where they are the same as before."""
        if self._drawn.get("picks") == (picks.tobytes(),):
            return
        self._remove("picks")
        self._drawn["picks"] = (picks.tobytes(),)
        if len(picks):
            self._nodes["picks"] = self._scene.add_point_cloud(
                _at("picks"), picks, PICKED, point_size=PICK_SHARE * size, point_shape="circle", precision="float32"
            )

    def _remove(self, name: str) -> None:
        self._drawn.pop(name, None)
        if name in self._nodes:
            self._nodes.pop(name).remove()


def _at(name: str) -> str:
    return f"/pair/{name}"


def _some(clouds: CloudSet, row: int) -> Floats32:
    """At most `MOST_POINTS` points of a cloud, in random order."""
    points = np.asarray(clouds[row].points_in_cam)
    return points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]


def placed(pose: Floats) -> tuple[Floats, Floats]:
    """A pose as viser takes it: quaternion (w first) and position."""
    return quat_wxyz(pose), pose[:3, 3]


def quat_wxyz(poses: Floats) -> Floats:
    """Quaternions (..., 4) of poses, w first."""
    return np.asarray(se3.to_quat_xyzw(poses)[..., [3, 0, 1, 2]])
