"""What frames and trajectories are like: stamps, poses, cameras, depth, and what is odd about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.colour_on_depth import Agreement, agreement, colour_doubts
from hodge_pipeline.sources.depth_units import PLAUSIBLE_DEPTH_M, SAMPLED_FRAMES, are_millimetres_as_tums, doubts_of
from hodge_pipeline.types import Bools, Camera, Floats, Floats32, Frame, PointCloud, Trajectory
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.text import UNKNOWN_UNIT, counted

LISTED = 5
"""Names, or cameras, that are listed: a limit on length."""
METRES, OWN_UNIT = "metres", "units of its own"
GAP, JUMP = 5.0, 10.0
"""Times the median step: what counts as a gap in time, and as a jump of the pose."""
LEAST_JUMP_M, LEAST_JUMP_DEG = 0.1, 20.0
"""Below these nothing is a jump, however still the camera is else: at 30 Hz they are 3 m/s and 600 °/s."""
FEWEST_SWEEPS, SWEEP_POINTS = 10, 300_000
"""Scans in sequence are more, and one has fewer points (128 beams, 2048 columns): a station's has millions."""
SECTORS, ALL_ROUND = 36, 0.9
"""Of ten degrees each; the share of them that holds points of a scanner that sees all round it."""
MOSTLY_EMPTY = 0.9
"""Share of an image without depth from which it is named: 32 images of red kitchen and fr1/xyz lack at most 26 %, one
of a covered camera, or of a wall too near, nearly all.
"""
ODDLY_LOST = 0.25
"""Share of a scan's points that are no numbers beyond that of the median scan, from which it is named: organised scans
of one sensor lose alike.
"""
MOST_READ = 10
"""Sweeps read, from the middle outward, for one with points."""


def frame_facts(frames: Sequence[Frame], oddities: list[str], unit: str = METRES) -> dict[str, Any]:
    """Facts of a sequence of frames as plain data, a few of its depth images read; what is odd goes to the list.

    `unit` is that of lengths between poses.
    """
    sequences = np.array([frame.sequence for frame in frames])
    stamps = np.array([frame.stamp_s for frame in frames])
    names = [str(frame.frame_id) for frame in frames]
    posed = np.array([frame.world_from_cam is not None for frame in frames])
    poses = np.array([np.eye(4) if frame.world_from_cam is None else frame.world_from_cam for frame in frames])
    together = (sequences[1:] == sequences[:-1]) if len(frames) > 1 else np.zeros(0, bool)
    _note_ids(frames, oddities)
    facts = {
        "sequences": [name for name in dict.fromkeys(sequences.tolist()) if name],
        **stamp_facts(stamps, together, names, oddities),
        "cameras": _cameras(Counter(frame.camera for frame in frames if frame.camera is not None)),
        "frames with a pose": int(posed.sum()),
        "frames with colour": sum(frame.read_colour is not None for frame in frames),
        "frames with depth": sum(frame.read_depth is not None for frame in frames),
        "frames with points": sum(frame.read_points is not None for frame in frames),
        **pose_facts(poses, together & posed[1:] & posed[:-1], names, oddities, unit),
    }
    without = len(frames) - facts["frames with depth"]
    if 0 < without < len(frames) and not facts["frames with points"]:
        bare = [str(frame.frame_id) for frame in frames if frame.read_depth is None]
        oddities.append(f"{without} of {len(frames)} frames have no depth: {listed(bare)}")
    return {**facts, **_depth_facts(frames, oddities), **_scanner_facts(frames, oddities)}


def _cameras(count_of: Counter[Camera]) -> list[str]:
    """A line each; of more than a few, as of photographs, a line for each size of image."""
    if len(count_of) <= LISTED:
        return [
            f"{c.width}x{c.height} fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g} ({counted(count, 'frame')})"
            for c, count in sorted(count_of.items(), key=str)
        ]
    focal_px: dict[str, list[float]] = {}
    for camera in count_of:
        focal_px.setdefault(f"{camera.width}x{camera.height}", []).append(camera.fx)
    return [
        f"{size} fx {min(fx):g} to {max(fx):g} ({counted(len(fx), 'camera')})" for size, fx in sorted(focal_px.items())
    ]


def _scanner_facts(frames: Sequence[Frame], oddities: list[str]) -> dict[str, Any]:
    """Whether the points look like those of a scanner that turns while it moves, by the frame that is nearest to the
    middle among those that can be read and have points.
    """
    cloud = _middle_cloud(frames, oddities) if len(frames) >= FEWEST_SWEEPS else None
    if cloud is None:
        return {}
    if cloud.times_s is not None:
        return {"scanner": "turns while it moves: its points have times"}
    sees_round = len(cloud) <= SWEEP_POINTS and _is_all_round(cloud.points_in_cam)
    return {"scanner": "sees all round"} if sees_round else {}


def _is_all_round(points: Floats32) -> bool:
    """Whether points (N, 3) lie on all sides of the z axis, most of them nearer to the horizon than to the axis: those
    of a depth camera lie on all sides of the axis that it looks along.
    """
    x, y, z = points.T
    level = np.abs(z) < np.hypot(x, y)
    turns = np.arctan2(y[level], x[level])
    seen = np.count_nonzero(np.bincount(((turns + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS))
    return bool(2 * np.count_nonzero(level) > len(points) and seen >= ALL_ROUND * SECTORS)


def _middle_cloud(frames: Sequence[Frame], oddities: list[str]) -> PointCloud | None:
    middle = len(frames) // 2
    for row in sorted(range(len(frames)), key=lambda row: abs(row - middle))[:MOST_READ]:
        read = frames[row].read_points
        if read is None:
            return None
        try:
            cloud = read()
        except (SourceError, OSError) as error:
            oddities.append(f"frame {frames[row].frame_id} cannot be read: {error}")
            continue
        if len(cloud):
            return cloud
        if (empty := f"frame {frames[row].frame_id} has no points") not in oddities:
            oddities.append(empty)
    return None


def trajectory_facts(trajectory: Trajectory, oddities: list[str]) -> dict[str, Any]:
    """Facts of a trajectory on its own."""
    names = [f"{stamp:.6f}".rstrip("0").rstrip(".") for stamp in trajectory.stamps_s]
    together = np.ones(max(len(trajectory) - 1, 0), bool)
    return {
        **stamp_facts(trajectory.stamps_s, together, names, oddities),
        **pose_facts(trajectory.world_from_cam, together, names, oddities),
    }


def stamp_facts(stamps_s: Floats, together: Bools, names: Sequence[str], oddities: list[str]) -> dict[str, Any]:
    """First, last and steps of stamps; `together (N - 1,)`: where a stamp and the next are of one sequence."""
    steps = np.diff(stamps_s)[together]
    after = np.flatnonzero(together)
    if (steps == 0).any():
        same = [names[row] for row in after[steps == 0]]
        oddities.append(f"{counted(len(same), 'stamp is|stamps are')} that of the one before: after {listed(same)}")
    if (steps < 0).any():
        back = counted(int((steps < 0).sum()), "stamp is|stamps are")
        oddities.append(f"{back} earlier than the stamp before: not in order of time")
    usual = float(np.median(steps)) if len(steps) else 0.0
    gaps = steps > GAP * usual
    if usual > 0 and gaps.any():
        at = after[np.argmax(steps)]
        oddities.append(
            f"{counted(int(gaps.sum()), 'gap')} in time of more than {GAP:g} steps; the longest, {steps.max():.6g} s, "
            f"between {names[at]} and {names[at + 1]}"
        )
    return {
        "first stamp": float(stamps_s[0]),
        "last stamp": float(stamps_s[-1]),
        "median step": usual if len(steps) else None,
        "largest step": float(steps.max()) if len(steps) else None,
    }


def pose_facts(
    world_from_cam: Floats, together: Bools, names: Sequence[str], oddities: list[str], unit: str = METRES
) -> dict[str, Any]:
    """Path length and extent of poses (N, 4, 4); `together (N - 1,)`: where a pose and the next belong together."""
    rows = np.flatnonzero(together)
    if not len(rows):
        return {}
    relative = se3.inverse(world_from_cam[rows]) @ world_from_cam[rows + 1]
    moved_m = np.linalg.norm(relative[:, :3, 3], axis=1)
    turned_deg = np.rad2deg(se3.rotation_angle(relative))
    for size, least, sign in (
        (moved_m, LEAST_JUMP_M, "m" if unit == METRES else UNKNOWN_UNIT),
        (turned_deg, LEAST_JUMP_DEG, "°"),
    ):
        jumps = size > max(JUMP * float(np.median(size)), least)
        if jumps.any():
            at = rows[np.argmax(size)]
            oddities.append(
                f"{counted(int(jumps.sum()), 'jump')} of the pose, the largest {size.max():.3g} {sign} between "
                f"{names[at]} and {names[at + 1]}; half of the steps are below {np.median(size):.3g} {sign}"
            )
    centres = world_from_cam[np.union1d(rows, rows + 1), :3, 3]
    return {
        f"path length in {unit}": float(moved_m.sum()),
        f"extent of the path in {unit}": [float(side) for side in np.ptp(centres, axis=0)],
    }


def _note_ids(frames: Sequence[Frame], oddities: list[str]) -> None:
    counts = Counter((frame.sequence, frame.frame_id) for frame in frames)
    twice = [str(name) for (_, name), count in counts.items() if count > 1]
    if twice:
        oddities.append(f"{len(twice)} frame ids are given more than once: {listed(twice)}")


def _depth_facts(frames: Sequence[Frame], oddities: list[str]) -> dict[str, Any]:
    """Depth range and invalid share of a few frames, evenly over the sequence, and their images that cannot be read."""
    with_depth = [frame for frame in frames if frame.read_depth is not None or frame.read_points is not None]
    depths, faults, lost_of = list[Floats32](), list[str](), dict[str, float]()
    edges = list[Agreement]()
    for row in evenly(len(with_depth), SAMPLED_FRAMES):
        frame = with_depth[row]
        try:
            depth, lost = _depth(frame)
            depths.append(depth.ravel())
        except (SourceError, OSError) as error:
            faults.append(str(error))
            continue
        edges += _colour_edges(frame, depth, faults)
        share = float((depths[-1] <= 0).mean()) if depths[-1].size else 1.0
        if share > MOSTLY_EMPTY and frame.read_depth is not None:
            oddities.append(f"frame {frame.frame_id}: {share:.0%} of its pixels have no depth")
        elif not depths[-1].size:
            oddities.append(f"frame {frame.frame_id} has no points")
        lost_of[str(frame.frame_id)] = lost
    usual = float(np.median(list(lost_of.values()))) if lost_of else 0.0
    for name, share in lost_of.items():
        if share > usual + ODDLY_LOST:
            oddities.append(f"frame {name}: {share:.0%} of its points are no numbers")
    values = np.concatenate(depths) if depths else np.zeros(0)
    valid = values[values > 0]
    median = float(np.median(valid)) if len(valid) else None
    missing = dict[str, Any]()
    if with_depth and with_depth[0].read_depth is not None:
        camera, widths = with_depth[0].camera, [frame.camera.width for frame in with_depth if frame.camera is not None]
        width = (max(widths),) if widths else ()
        units = doubts_of(valid, *width)
        if are_millimetres_as_tums(valid, *width):
            missing = {"missing": ["source.reader.depth_scale=1000"]}
        oddities.extend(str(doubt) for doubt in (*units, *colour_doubts(edges, camera)))
    elif median is not None and not PLAUSIBLE_DEPTH_M[0] < median < PLAUSIBLE_DEPTH_M[1]:
        oddities.append(f"the median distance is {median:.3g} m: are the points in metres?")
    return {
        "frames looked into": len(depths),
        "depth range in metres": [float(valid.min()), float(valid.max())] if len(valid) else None,
        "median depth in metres": median,
        "share without depth": float(1 - len(valid) / len(values)) if len(values) else None,
        "unreadable among them": faults,
    } | missing


def _depth(frame: Frame) -> tuple[Floats32, float]:
    """The depth image, or the distances of a cloud's points, since a scanner sees all round; and the share of points
    that are no numbers.
    """
    if frame.read_depth is not None:
        return frame.read_depth(), 0.0
    assert frame.read_points is not None
    cloud = frame.read_points()
    distances = np.asarray(np.linalg.norm(cloud.points_in_cam, axis=1), np.float32)
    return distances, cloud.no_numbers / max(len(cloud) + cloud.no_numbers, 1)


def _colour_edges(frame: Frame, depth_m: Floats32, faults: list[str]) -> list[Agreement]:
    """How edges of colour agree with those of depth; a colour image that cannot be read goes to the faults."""
    try:
        colour = None if frame.read_colour is None else frame.read_colour()
    except (SourceError, OSError) as error:
        faults.append(str(error))
        return []
    return [] if colour is None or frame.read_depth is None else agreement(depth_m, colour)


def listed(names: Sequence[object]) -> str:
    """The first few, and a sign that there are more."""
    return ", ".join(map(str, names[:LISTED])) + (" …" if len(names) > LISTED else "")
