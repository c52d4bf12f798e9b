"""Long sequences: each frame is followed from the last key frame by optical flow, and key frames alone are kept.

A frame becomes a key frame where the camera has moved far enough from the last one, or sees too little of what that
saw. Where flow finds no motion, as without texture, the frame's cloud is registered to the key frame's instead, and
flow tries again from there. The sequence is cut into blocks that are tracked side by side, so nothing depends on how
many workers there are, and memory holds one block a worker, never the sequence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.odometry import SURE_FITNESS, OdometryOptions
from hodge_pipeline.registration.tracking.blocks import TrackedBlock
from hodge_pipeline.registration.tracking.flow import Followed, follow
from hodge_pipeline.registration.tracking.frame import FEWEST_FOLLOWED, TrackedFrame
from hodge_pipeline.registration.tracking.moving import AT_REST, Moments, contradicting, misplaced, rival_motion
from hodge_pipeline.registration.tracking.sightings import Sightings
from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.types import Edges, Floats, Frame, Ints, PointCloud, Registration

FRAMES_IN_BLOCK = 96
"""Three seconds at frame rate; the first and the last frame of a block are key frames, however little they moved."""
LONGEST_GUESS = 4.0
"""Frame steps over which a motion is taken to go on as it was."""
FEW_FOLLOWED, SMALL_SHARE = 60, 0.35
"""Inliers, and share of the key frame's corners, below which a frame becomes a key frame."""
DOUBTFUL = 0.25
"""Share of the image that contradicts a motion, or follows another, above which the motion may be an object's: that of
most of the image is taken, so that at a half either may be the camera's.
"""
MISPLACED = 0.2
"""Share of pixels whose depth contradicts the motion by optical flow, above which the clouds are registered, and their
motion taken where it halves that share. Of a bare room whose corners lie on an object, half of the frames have 0.6 and
more; 3 in 4 of red kitchen's and of fr1/rpy's, where nothing moves, less than 0.15.
"""
KEPT_FITNESS = 0.5
"""Share of a cloud on the key frame's below which a registration is tried from elsewhere too: most of it is new."""
CORNERS_A_SAMPLE = 75.0
"""Corners that count as one independent measurement, as matches of landmarks do."""


@dataclass(frozen=True)
class TrackingOptions:
    """How frames are followed: `clouds` of key frames; a frame that has moved `distance_m` or `angle_rad` from the last
    key frame becomes one, and so does, where clouds are registered, one that shares less than `KEPT_FITNESS` with it.
    """

    clouds: CloudOptions
    odometry: OdometryOptions
    distance_m: float
    angle_rad: float


@dataclass(frozen=True)
class FrameBlock:
    """Consecutive rows (M,) of one sequence, their frames and times; the first is there for its velocity alone where
    `warm_up`.
    """

    rows: Ints
    frames: tuple[Frame, ...]
    times: Floats
    warm_up: bool


def frame_blocks(rows: Ints, frames: tuple[Frame, ...], times: Floats) -> list[FrameBlock]:
    """The blocks of one sequence: `frames (N,)` and `times (N,)` are the whole source's, `rows` the sequence's."""
    blocks = []
    for start in range(0, max(1, len(rows) - 1), FRAMES_IN_BLOCK):
        first = max(0, start - 1)
        part = rows[first : start + FRAMES_IN_BLOCK + 1]
        blocks.append(FrameBlock(part, tuple(frames[row] for row in part), times[part], start > 0))
    return blocks


@plugin_errors()
def track_block(options: TrackingOptions, block: FrameBlock) -> TrackedBlock:
    """The block, tracked."""
    return _Tracker(options, block).run()


class _Tracker:
    """Follows one block: the last key frame, the last frame tracked, and the frame after it where that was lost.

    `_rows` holds for each place its key frame's place, the motion to it, and the fitness, NaN for a guess.
    """

    def __init__(self, options: TrackingOptions, block: FrameBlock) -> None:
        self._options, self._block = options, block
        self._registrar, self._limits = options.odometry.registration, options.odometry
        self._rows: dict[int, tuple[int, Floats, float]] = {}
        self._keys: list[TrackedFrame] = []
        self._clouds: dict[int, tuple[PointCloud, str]] = {}
        self._steps: list[tuple[int, int, Registration]] = []
        self._corner_points: dict[int, Floats] = {}
        self._sightings: dict[tuple[int, int], Followed] = {}
        self._moving, self._doubtful, self._blank = set[int](), set[int](), set[int]()
        self._unread = dict[int, str]()
        self._velocity: Floats = np.zeros(6)
        self._times = block.times + [frame.colour_delay_s for frame in block.frames]
        self._usual_step = float(np.median(np.diff(block.times))) if len(block.times) > 1 else 1.0

    def run(self) -> TrackedBlock:
        first, count = int(self._block.warm_up), len(self._block.rows)
        start = self._view(first)
        if self._block.warm_up:
            self._warm_up(start)
        self._begin(start)
        self._look_at(start)
        for place in range(first + 1, count):
            view = self._view(place)
            self._look_at(view)
            self._follow(view, is_last=place == count - 1)
        self._keep_cloud(self._keys[-1])
        rows = self._block.rows
        anchors, motions, fitness = zip(*(self._rows[place] for place in range(first, count)), strict=True)
        pairs = np.array([(rows[i], rows[j]) for i, j, _ in self._steps], np.int64).reshape(-1, 2)
        return TrackedBlock(
            keys=rows[list(self._clouds)],
            clouds=tuple(cloud for cloud, _ in self._clouds.values()),
            steps=Edges.of(pairs, "sequential").with_registrations([step for _, _, step in self._steps]),
            rows=rows[first:],
            anchors=rows[list(anchors)],
            key_from_row=np.array(motions),
            fitness=np.array(fitness),
            moving=self._rows_at(self._moving),
            doubtful=self._rows_at(self._doubtful),
            blank=self._rows_at(self._blank),
            apart=self._rows_at(self._apart()),
            unread=rows[list(self._unread)],
            unread_why=np.array(list(self._unread.values()), np.str_),
            notes=tuple(note for _, note in self._clouds.values() if note),
            sightings=self._kept_sightings(first),
        )

    def _look_at(self, view: TrackedFrame) -> None:
        if view.is_blank:
            self._blank.add(view.place)
        if view.unread:
            self._unread[view.place] = view.unread

    def _apart(self) -> set[int]:
        """The places of blank frames that clouds placed, whose key frame flow has joined with the next one."""
        flowed = {key for key, following, _ in self._steps if (key, following) in self._sightings}
        return {place for place in self._blank if self._rows[place][0] in flowed - {place}}

    def _rows_at(self, places: set[int]) -> Ints:
        """The rows at these places, the one of the warm-up left out."""
        return self._block.rows[[place for place in sorted(places) if place >= self._block.warm_up]]

    def _view(self, place: int) -> TrackedFrame:
        return TrackedFrame(self._block.frames[place], place, self._options.clouds, self._registrar)

    def _warm_up(self, start: TrackedFrame) -> None:
        before = self._view(0)
        found = self._flowed(start, before, np.eye(4))
        step = found or self._registrar.register(start.prepared, before.prepared, np.eye(4))
        if self._is_good(step):
            start.twist = self._velocity = -se3.log(step.i_from_j) / self._duration(0, start.place)

    def _begin(self, view: TrackedFrame) -> None:
        """From here on this view is the key frame, and the last frame tracked."""
        if self._keys:
            self._keep_cloud(self._keys.pop())
        self._keys.append(view)
        self._rows[view.place] = (view.place, np.eye(4), 1.0)
        self._last, self._key_from_last = view, np.eye(4)
        self._missed: TrackedFrame | None = None
        self._is_cut = False

    def _keep_cloud(self, key: TrackedFrame) -> None:
        """All that is kept of a key frame that nothing follows any more; of the first, the block before keeps it."""
        if key.place > self._block.warm_up or not self._block.warm_up:
            self._clouds[key.place] = key.cloud_and_note

    def _promote(self, view: TrackedFrame, step: Registration) -> None:
        self._steps.append((self._keys[-1].place, view.place, step))
        self._begin(view)

    def _follow(self, view: TrackedFrame, is_last: bool) -> None:
        key = self._keys[-1]
        found = self._flowed(key, view, self._key_from_last @ self._ahead(view))
        if found is None and self._last is not key and self._last.corners is not None:
            found = self._flowed_from_last(view)
        if found is None:
            found = self._registered_by_clouds(view)
        if not self._is_good(found):
            self._lose(view, is_last)
            return
        seconds = self._duration(self._last.place, view.place)
        view.twist = self._velocity = se3.log(se3.inverse(self._key_from_last) @ found.i_from_j) / seconds
        self._rows[view.place] = (self._keys[-1].place, found.i_from_j, found.fitness)
        self._last, self._key_from_last, self._missed, self._is_cut = view, found.i_from_j, None, False
        has_left = self._has_moved(found.i_from_j) or self._sees_little(view)
        if is_last or (has_left and len(view.cloud)):  # a key frame without depth is joined to nothing
            self._promote(view, found)

    def _flowed(self, key: TrackedFrame, view: TrackedFrame, guess: Floats) -> Registration | None:
        """The motion by optical flow, its inliers kept as sightings; None where it fails; that of the clouds where this
        fits the depth much better, as in a bare room whose corners lie on a moving object.
        """
        if key.corners is None or key.image is None or view.image is None:
            return None
        found = follow(key.corners, view.image, guess)
        if found is None:
            return None
        found, against = self._of_most_area(key, view, found, guess)
        if len(found.rows) < FEWEST_FOLLOWED or found.share < self._limits.min_fitness:
            return None
        off = misplaced(key.image, view.image, found.key_from_view, self._moments(key, view, found.key_from_view))
        if off > MISPLACED:
            by_clouds = self._registrar.register(key.prepared, view.prepared, guess)
            if self._is_good(by_clouds) and 2 * misplaced(key.image, view.image, by_clouds.i_from_j) < off:
                self._doubt(view, max(contradicting(key.image, view.image, by_clouds.i_from_j), key.left_out))
                return by_clouds
        self._doubt(view, max(against, key.left_out))
        self._corner_points[key.place] = key.corners.points
        self._sightings[key.place, view.place] = found
        information = found.information / CORNERS_A_SAMPLE
        motion, count = found.key_from_view, len(found.rows)
        return Registration(motion, information, found.share, found.rmse_m, count, 0, True, by_landmarks=True)

    def _of_most_area(
        self, key: TrackedFrame, view: TrackedFrame, found: Followed, guess: Floats
    ) -> tuple[Followed, float]:
        """The motion found, or another that more of the image follows, and the share that contradicts it; the depth of
        what moves is removed from the key frame.
        """
        assert key.corners is not None and view.image is not None
        moments = self._moments(key, view, found.key_from_view)
        against, rival = rival_motion(key.corners, view.image, found, guess, moments)
        if rival is not None and len(rival.followed.rows) >= FEWEST_FOLLOWED:
            self._moving.add(view.place)
            key.leave_out(rival.moving, rival.corners if rival.fits_better else key.corners)
            if rival.fits_better:
                self._sightings = {pair: one for pair, one in self._sightings.items() if pair[0] != key.place}
                found, against = rival.followed, rival.contradicting
        return found, against

    def _moments(self, key: TrackedFrame, view: TrackedFrame, key_from_view: Floats) -> Moments:
        """Velocities and delays of both frames, the view's by its motion since the last frame tracked; at rest before
        the first key frame.
        """
        if not self._keys:
            return AT_REST
        key_from_last = self._key_from_last if key is self._keys[-1] else np.eye(4)
        step = se3.log(se3.inverse(key_from_last) @ key_from_view)
        twist = view.twist if view is self._last else step / self._duration(self._last.place, view.place)
        return Moments(key.twist, twist, key.colour_delay_s, view.colour_delay_s)

    def _doubt(self, view: TrackedFrame, share: float) -> None:
        if share > DOUBTFUL:
            self._doubtful.add(view.place)

    def _flowed_from_last(self, view: TrackedFrame) -> Registration | None:
        """The motion from the last frame tracked, which becomes a key frame, where flow finds this one."""
        found = self._flowed(self._last, view, self._ahead(view))
        if found is not None:
            self._promote(self._last, self._step_to_last())
        return found

    def _step_to_last(self) -> Registration:
        """The step from the key frame to the last frame tracked."""
        key, last = self._keys[-1], self._last
        _, key_from_last, _ = self._rows[last.place]
        step = self._flowed(key, last, key_from_last)
        return step or self._registrar.register(key.prepared, last.prepared, key_from_last)

    def _registered_by_clouds(self, view: TrackedFrame) -> Registration:
        """The motion by the registrar of odometry."""
        found = self._confirmed(self._keys[-1], view, self._registered(self._keys[-1], view, self._key_from_last))
        if found.fitness < KEPT_FITNESS and self._last.place != self._keys[-1].place:
            found = self._from_last(view, found)
        if not self._is_good(found) and self._missed is not None:
            found = self._from_missed(view, self._missed, found)
        return found

    def _from_last(self, view: TrackedFrame, to_key: Registration) -> Registration:
        """The view seen from the last frame tracked, which becomes a key frame, where these two share more."""
        found = self._confirmed(self._last, view, self._registered(self._last, view, np.eye(4)))
        if found.fitness <= to_key.fitness or not self._is_good(found):
            return to_key
        self._promote(self._last, self._step_to_last())
        return found

    def _from_missed(self, view: TrackedFrame, missed: TrackedFrame, to_key: Registration) -> Registration:
        """The motion from the frame lost before, which becomes a key frame by a guess, where these two register."""
        found = self._registrar.register(missed.prepared, view.prepared, np.eye(4))
        found = self._confirmed(missed, view, found)
        if not self._is_good(found):
            return to_key
        self._promote_by_guess(missed)
        return found

    def _confirmed(self, target: TrackedFrame, view: TrackedFrame, by_clouds: Registration) -> Registration:
        """The motion by flow from where clouds put the view. Without one that of the clouds, of fitness 0 where flow
        could tell and they are not sure: from one frame to the next that is a cut in the recording.
        """
        by_flow = self._flowed(target, view, by_clouds.i_from_j) if self._is_good(by_clouds) else None
        if by_flow is None and by_clouds.fitness < SURE_FITNESS and target.can_be_followed and view.can_be_followed:
            self._is_cut |= view.place == self._last.place + 1
            return replace(by_clouds, fitness=0.0)
        return by_flow or by_clouds

    def _lose(self, view: TrackedFrame, is_last: bool) -> None:
        """Its motion is a guess; the next frame tries the same key frame again."""
        if is_last:
            self._promote_by_guess(view)
            return
        if len(view.cloud):
            self._missed = view
        self._rows[view.place] = (self._keys[-1].place, self._guessed(view).i_from_j, np.nan)

    def _promote_by_guess(self, view: TrackedFrame) -> None:
        """The view becomes a key frame by a guess; over a cut by no step, since clouds alone would bridge it."""
        if self._is_cut:
            self._begin(view)
        else:
            self._promote(view, self._guessed(view))

    def _guessed(self, view: TrackedFrame) -> Registration:
        motion = self._key_from_last @ self._ahead(view)
        return Registration(motion, np.zeros((6, 6)), 0.0, np.nan, 0, 0, False)

    def _registered(self, target: TrackedFrame, source: TrackedFrame, standing: Floats) -> Registration:
        """From a motion that goes on as before and, where that may not have worked, from `standing`, that of none."""
        step = self._registrar.register(target.prepared, source.prepared, standing @ self._ahead(source))
        if step.fitness < KEPT_FITNESS:
            again = self._registrar.register(target.prepared, source.prepared, standing)
            step = again if again.fitness > step.fitness else step
        return step

    def _is_good(self, step: Registration) -> bool:
        return step.fitness >= self._limits.min_fitness

    def _ahead(self, view: TrackedFrame) -> Floats:
        seconds = min(self._duration(self._last.place, view.place), LONGEST_GUESS * self._usual_step)
        return se3.exp(self._velocity * seconds)

    def _duration(self, i: int, j: int) -> float:
        """Seconds between the colour images, which flow follows; two frames may share one."""
        return max(float(self._times[j] - self._times[i]), self._usual_step / 2, 1e-6)

    def _has_moved(self, key_from_view: Floats) -> bool:
        moved = float(np.linalg.norm(key_from_view[:3, 3]))
        turned = float(se3.rotation_angle(key_from_view))
        return moved >= self._options.distance_m or turned >= self._options.angle_rad

    def _sees_little(self, view: TrackedFrame) -> bool:
        """Whether flow lost most corners of the key frame; what the registrar found is judged by its fitness."""
        key = self._keys[-1]
        found = self._sightings.get((key.place, view.place))
        if found is None or key.corners is None:
            return False
        corners = len(key.corners)
        return len(found.rows) < max(SMALL_SHARE * corners, min(FEW_FOLLOWED, 2 * SMALL_SHARE * corners))

    def _kept_sightings(self, first: int) -> Sightings:
        """The sightings from the first key frame on."""
        kept = {pair: found for pair, found in self._sightings.items() if pair[1] > first}
        return Sightings.of(kept, self._corner_points, self._block.rows)
