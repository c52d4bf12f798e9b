"""The 3-D scene of a review: clouds, cameras, edges in the colours of their verdicts, and the pair looked at."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.result import CONSISTENT, WRONG
from hodge_pipeline.recording.shapes import VERDICT_COLOURS, or_grey
from hodge_pipeline.review.closeup import Closeup, placed, quat_wxyz
from hodge_pipeline.review.listing import witnesses
from hodge_pipeline.review.looking import Shown, ball, shown_pair
from hodge_pipeline.review.picking import nearest_point, nearest_segment
from hodge_pipeline.review.session import Session
from hodge_pipeline.types import CloudSet, Floats, Floats32, Ints
from hodge_pipeline.types.axes import up_and_ahead

SELECTED, BEFORE = (190, 0, 190), (170, 170, 200)
"""Colours of the selected edge, and of the way from where a camera was before the latest decision."""
MOST_POINTS = 3_000_000
"""Points of the overview: 9 bytes each, 27 MB for a page to receive."""
SAMPLED = 3000
"""Points by which the scene is centred."""
CROWD = 200
"""Cameras above which they are drawn smaller, so that they do not hide the edges."""
BLINK_S = 0.6
"""Seconds from one side of a blink to the other."""
BARELY = 1e-7
"""Change of a pose's numbers below which nothing is sent."""


class Scene:
    """Draws a session with viser and turns clicks into selections; a thread of its own follows the session."""

    def __init__(self, session: Session, server: Any) -> None:
        self._session, self._server = session, server
        self._subject = session.subject
        self._size = 1.0
        self._poses = np.zeros((0, 4, 4))
        self._clouds: dict[int, Any] = {}
        self._shown: dict[str, tuple[Any, ...]] = {}
        self._closed = threading.Event()
        self._looked: dict[int, tuple[Any, Any]] = {}
        self._eyes: dict[int, tuple[int, int, int]] = {}
        self._begin()
        server.on_client_connect(lambda _: session.bump())
        server.scene.on_click()(lambda event: self._clicked(event, shift=False))
        server.scene.on_click(modifier="shift")(lambda event: self._clicked(event, shift=True))
        self._thread = threading.Thread(target=self._follow, name="scene", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread that draws."""
        self._closed.set()
        self._session.bump()
        self._thread.join()

    def _begin(self) -> None:
        """Draw a subject that was just opened, with all its clouds."""
        scene, poses = self._server.scene, self._session.settled.world_from_cam
        self._eye: tuple[int, int, int] | None = None
        self._first_look(self.overview(poses))
        scene.set_up_direction(tuple(self._up))
        self._server.initial_camera.up = tuple(self._up)
        self._clouds = {}
        scene.add_frame("/clouds", show_axes=False)
        self._closeup = Closeup(self._session, self._server)
        if self._subject.clouds is not None:
            self._add_clouds(self._subject.clouds, poses)
        self._poses, self._before = poses.copy(), (0, poses)

    def _add_clouds(self, clouds: CloudSet, poses: Floats) -> None:
        """Send the clouds, thinned; points are drawn 1 cm large at least where lengths are metres."""
        step = thinning(clouds.offsets, MOST_POINTS)
        size = max(0.004 * self._size, 0.01 if self._subject.unit == "m" else 0.0)
        for row in range(len(clouds)):
            points, colours = thinned(clouds, row, step)
            if len(points) and np.isfinite(poses[row]).all():
                wxyz, position = placed(poses[row])
                self._clouds[row] = self._server.scene.add_point_cloud(
                    f"/clouds/{row}", points, colours, point_size=size, point_shading="flat", wxyz=wxyz,
                    position=position,
                )  # fmt: skip

    def _follow(self) -> None:
        """Draw after every change of the session; while it blinks also between changes, the other side each time."""
        session, version, flip = self._session, -1, False
        while not self._closed.is_set():
            with session.changed:
                blinks = session.look.mode == "blink"
                seen = version
                session.changed.wait_for(lambda: session.version != seen, timeout=BLINK_S if blinks else None)  # noqa: B023
                flip = not flip if blinks and session.version == version else flip
                version = session.version
            if not self._closed.is_set():
                self.draw(flip)

    def overview(self, poses: Floats) -> tuple[Floats, Floats]:
        """The position (3,) that shows the whole scene at poses (V, 4, 4), and its middle (3,); sets up and size too.

        The view is from behind and above: 1.8 sizes up and 1.3 back show the scene in viser's field of view.
        """
        known = poses[se3.has_pose(poses)]
        _, radius = ball(known[:, :3, 3])
        self._size = max(radius, 0.5) if self._subject.unit == "m" else radius
        clouds = self._subject.clouds
        self._up, ahead = up_and_ahead(known if len(known) else np.eye(4)[None], self._subject.is_scanner)
        centre, radius = ball(np.concatenate([known[:, :3, 3], _sampled(clouds, poses)]))
        return centre + max(radius, self._size) * (1.8 * self._up - 1.3 * ahead), centre

    def _first_look(self, view: tuple[Floats, Floats]) -> None:
        """Set the camera of pages that connect: its position and what it looks at."""
        self._server.initial_camera.position, self._server.initial_camera.look_at = map(tuple, view)

    def draw(self, flip: bool = False) -> None:
        """Bring the scene up to date with the session; what has not changed is not sent again."""
        with self._session.changed:
            session = self._session
            settled, look, table = session.settled, session.look, session.table
            is_new = session.subject is not self._subject
            pair = shown_pair(session, flip)
            cycles = witnesses(session, look.selected) if look.selected >= 0 else []
            self._subject = session.subject
        if is_new:
            self._server.scene.reset()
            self._shown = {}
            self._begin()
        with self._server.atomic():
            self._move(settled.world_from_cam, settled.revision)
            self._cameras(settled.world_from_cam)
            for verdict in VERDICT_COLOURS:
                rows = np.flatnonzero((table.edges.verdict == verdict) & (settled.weights > 0))
                rows = rows if verdict in look.verdicts else rows[:0]
                self._lines(
                    f"/edges/{verdict}", settled.world_from_cam, table.graph.edges[rows], VERDICT_COLOURS[verdict], 2.5
                )
            chosen = table.graph.edges[[look.selected]] if look.selected >= 0 else np.zeros((0, 2), np.int64)
            self._lines("/edges/selected", settled.world_from_cam, chosen, SELECTED, 6.0)
            for closes, name, colour in (
                (True, "closing", VERDICT_COLOURS[CONSISTENT]),
                (False, "failing", VERDICT_COLOURS[WRONG]),
            ):
                of_cycles = [np.stack([c.along, np.roll(c.along, -1)], axis=1) for c in cycles if c.closes == closes]
                sides = np.concatenate([np.zeros((0, 2), np.int64), *of_cycles])
                self._lines(f"/cycles/{name}", settled.world_from_cam, sides, colour, 3.5)
            scene = self._server.scene
            scene.add_frame("/clouds", show_axes=False, visible=pair is None)
            self._closeup.draw(pair, self._subject.clouds, self._up, self._size)
        self._turn_to(pair, look.home)

    def _move(self, poses: Floats, revision: int) -> None:
        """Move the clouds to poses (V, 4, 4), and draw a line from where each camera was before the latest decision."""
        if np.array_equal(poses, self._poses, equal_nan=True):
            return
        for row in np.flatnonzero(np.abs(poses - self._poses).max(axis=(1, 2)) > BARELY).tolist():
            if row in self._clouds:
                self._clouds[row].wxyz, self._clouds[row].position = placed(poses[row])
        if revision != self._before[0]:
            self._before = revision, self._poses
        self._poses = poses.copy()
        ways = np.stack([self._before[1][:, :3, 3], poses[:, :3, 3]], axis=1)
        self._draw_lines("/before", ways[np.ptp(ways, axis=1).max(axis=1) > BARELY], BEFORE, 1.0)

    def _cameras(self, poses: Floats) -> None:
        """Draw axes at the poses, 4 % of the scene's size long, shorter where there are many."""
        if self._same("/cameras", poses):
            return
        known = poses[se3.has_pose(poses)]
        length = 0.04 * self._size / max(1.0, (len(known) / CROWD) ** 0.5)
        self._server.scene.add_batched_axes(
            "/cameras", quat_wxyz(known), known[:, :3, 3], axes_length=length,
            axes_radius=length / 12,
        )  # fmt: skip

    def _lines(self, name: str, poses: Floats, pairs: Ints, colour: tuple[int, ...], width_px: float) -> None:
        """Draw pairs (P, 2) of poses as lines, where they or the poses changed."""
        if not self._same(name, poses, pairs):
            self._draw_lines(name, poses[pairs][:, :, :3, 3], colour, width_px)

    def _draw_lines(self, name: str, segments: Floats, colour: tuple[int, ...], width_px: float) -> None:
        """Draw segments (N, 2, 3), those that are not finite left out."""
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        if not len(segments):
            self._remove(name)
            return
        self._server.scene.add_line_segments(
            name, segments.astype(np.float32), colour, thickness=width_px, thickness_units="screen"
        )

    def _turn_to(self, pair: Shown | None, home: int) -> None:
        """Turn every page to the pair; back to its own view when the pair is left; to the overview when `home` grew.

        A page that connects, also again, starts with the same view as `initial_camera`: until it has set itself up it
        may lose what is sent.
        """
        eye = (-1, -1, home) if pair is None else (pair.i, pair.j, int(pair.wants_points))
        if eye != self._eye:
            self._eye, self._view = eye, self._view_of(pair)
            self._first_look(self._view)
        for number, client in self._server.get_clients().items():
            is_known, before = number in self._eyes, self._eyes.get(number, (-1, -1, home))
            self._eyes[number] = eye
            if before == eye:
                continue
            if pair is not None and is_known:
                self._looked.setdefault(number, (client.camera.position, client.camera.look_at))
            if pair is None and number in self._looked:
                client.camera.position, client.camera.look_at = self._looked.pop(number)
                continue
            if pair is None:
                client.camera.up_direction = self._up
            client.camera.position, client.camera.look_at = self._view

    def _view_of(self, pair: Shown | None) -> tuple[Floats, Floats]:
        """The position (3,) that shows the pair, or the overview, and its middle (3,)."""
        if pair is None:
            return self.overview(self._session.settled.world_from_cam)
        back = pair.world_from_i[:3, 3] - pair.middle
        way = back + 0.8 * np.linalg.norm(back) * self._up
        return pair.middle + 2.2 * pair.size_m * way / max(float(np.linalg.norm(way)), 1e-9), pair.middle

    def _same(self, name: str, *drawn: Any) -> bool:
        """Whether this name was drawn with the same arrays before; if not, they are remembered."""
        before = self._shown.get(name)
        if before is not None and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(before, drawn, strict=True)):
            return True
        self._shown[name] = tuple(np.array(one) for one in drawn)
        return False

    def _remove(self, name: str) -> None:
        self._shown.pop(name, None)
        if self._server.scene.get_handle_by_name(name) is not None:
            self._server.scene.remove_by_name(name)

    def _clicked(self, event: Any, *, shift: bool) -> None:
        """Select the edge nearest to the click, or with shift the frame; in a pair side by side pick a point."""
        origin, ray = np.asarray(event.ray_origin, float), np.asarray(event.ray_direction, float)
        session = self._session
        with session.changed:
            pair = shown_pair(session, False)
            poses, table, look = session.settled.world_from_cam, session.table, session.look
            drawn = np.isin(table.edges.verdict, look.verdicts) & (session.settled.weights > 0)
        if pair is not None and pair.wants_points and self._subject.clouds is not None:
            self._pick_point(pair, origin, ray)
        elif shift:
            frame = nearest_point(origin, ray, np.nan_to_num(poses[:, :3, 3], nan=np.inf))
            if frame is not None:
                session.pick((*look.picked[-1:], frame))
        elif pair is None:
            rows = np.flatnonzero(drawn)
            at = nearest_segment(origin, ray, poses[table.graph.edges[rows]][:, :, :3, 3])
            if at is not None:
                session.select(int(rows[at]))

    def _pick_point(self, pair: Shown, origin: Floats, ray: Floats) -> None:
        """Pick the point nearest to the ray, in the first cloud and in the second by turns."""
        clouds = self._subject.clouds
        assert clouds is not None
        row, pose = (pair.i, pair.world_from_i) if pair.next_is_first else (pair.j, pair.world_from_j)
        points = np.asarray(clouds[row].points_in_cam, float)
        at = nearest_point(origin, ray, se3.transform(pose, points))
        if at is not None:
            self._session.click_point(points[at])


def thinning(offsets: Ints, most: int) -> int:
    """The stride that leaves at most about `most` points of clouds with these offsets (N + 1,)."""
    return max(1, -(-int(offsets[-1]) // most))


def thinned(clouds: CloudSet, row: int, step: int) -> tuple[Floats32, np.ndarray[Any, np.dtype[np.uint8]]]:
    """Every `step`-th point of a cloud, in its camera's axes, and its colour; grey where there is none."""
    entry = slice(int(clouds.offsets[row]), int(clouds.offsets[row + 1]), step)
    points, colours = np.asarray(clouds.points[entry]), np.asarray(clouds.colours[entry])
    return points, or_grey(colours, len(points))


def _sampled(clouds: CloudSet | None, world_from_cam: Floats) -> Floats:
    """A few of the points (N, 3) of all clouds, in the world."""
    if clouds is None or not int(clouds.offsets[-1]):
        return np.zeros((0, 3))
    rows = np.arange(0, int(clouds.offsets[-1]), thinning(clouds.offsets, SAMPLED))
    owner = np.searchsorted(clouds.offsets, rows, side="right") - 1
    points = se3.transform(world_from_cam[owner], np.asarray(clouds.points[rows], float)[:, None])[:, 0]
    return points[np.isfinite(points).all(axis=1)]
