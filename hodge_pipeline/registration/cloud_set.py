"""From all frames to one `CloudSet`, in blocks, with notes on the frames whose clouds are odd."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.clouds import CloudCounts, CloudOptions, Oddity, make_or_report
from hodge_pipeline.stages import Advance, Workers, in_order, no_progress
from hodge_pipeline.types import CloudSet, Floats, Frame
from hodge_pipeline.types.notes import Note, notes_of

FRAMES_IN_BLOCK = 16
"""Frames whose clouds a worker makes, and holds, at once."""
LISTED_NOTES = 5
"""Frames with the same note that are named; more are counted."""
FACTOR_OF_UNITS = 50.0
"""Scans of one scene differ less in reach; millimetres and metres differ by 1000."""
BLANK = "its depth is sound, but its colour image shows nothing: black, or of one even colour"


def prepare_clouds(
    frames: Sequence[Frame], options: CloudOptions, workers: Workers, folder: Path, advance: Advance = no_progress
) -> tuple[CloudSet, tuple[Note, ...]]:
    """The clouds of all frames, in their order, in a folder, and notes on those that gave none, or a cloud that is odd.

    A frame that cannot be read gets an empty cloud. Raises `SourceError` where no frame gave a single point.
    """
    every: list[CloudCounts] = []

    def counted_in(block: tuple[CloudSet, list[CloudCounts]]) -> CloudSet:
        every.extend(block[1])
        advance(len(block[1]))
        return block[0]

    made = workers.map(partial(_make_block, options=options), in_blocks(frames))
    clouds = CloudSet.write(folder, map(counted_in, in_order(made)))
    odd = [counts.odd for counts in every if counts.odd is not None]
    if not any(counts.valid for counts in every):
        reason = odd[0] if odd else "the source has no frames"
        raise no_clouds(frames, reason)
    empty = [str(counts.odd) for counts in every if counts.odd is not None and not counts.valid]
    odd += [Oddity(frame.frame_id, BLANK) for frame, counts in zip(frames, every, strict=True) if counts.blank]
    of_other_units = _of_other_units(frames, np.array([counts.reach_m for counts in every]))
    return clouds, (
        *([Note("no cloud", len(empty), empty[0])] if empty else []),
        *notes_of("clouds", shortened(odd)),
        *notes_of("other units", shortened(of_other_units)),
        *notes_of("clouds", _no_returns(every)),
    )


def _of_other_units(frames: Sequence[Frame], reach_m: Floats) -> list[Oddity]:
    usual = float(np.nanmedian(reach_m)) if np.isfinite(reach_m).any() else np.nan
    odd = np.flatnonzero((reach_m > FACTOR_OF_UNITS * usual) | (reach_m < usual / FACTOR_OF_UNITS))
    others = (
        f"the others {usual:.3g} m: write it in those of the others (the reader's units_per_metre is 1000 for "
        "millimetres, but holds for all)"
    )
    return [
        Oddity(frames[row].frame_id, "it seems to have other units", f"it reaches {reach:.3g} m, {others}")
        for row, reach in zip(odd.tolist(), reach_m[odd].tolist(), strict=True)
    ]


def in_blocks(frames: Sequence[Frame]) -> list[Sequence[Frame]]:
    """The frames in blocks for workers."""
    return [frames[start : start + FRAMES_IN_BLOCK] for start in range(0, len(frames), FRAMES_IN_BLOCK)]


def no_clouds(frames: Sequence[Frame], first: object) -> SourceError:
    """What to say where no frame gave a point; `first`: what was wrong with the first of them."""
    return SourceError(
        f"none of the {len(frames)} frames gave a point cloud: hodge inspect shows size and range of their depth; the "
        f"first: {first}"
    )


def _no_returns(every: Sequence[CloudCounts]) -> tuple[str, ...]:
    """The note that counts the points of scans that are no returns, where there are any."""
    lost = sum(counts.no_returns for counts in every)
    if not lost:
        return ()
    looked_at = sum(counts.looked_at for counts in every)
    return (f"{lost} of {looked_at} points ({lost / looked_at:.1%}) are no returns (zero, or no number): left out",)


def shortened(odd: Sequence[Oddity]) -> tuple[str, ...]:
    """A note for each oddity: of many with the same `what` the first ones, and how many more there are."""
    alike: dict[str, list[Oddity]] = {}
    for one in odd:
        alike.setdefault(one.what, []).append(one)
    more = tuple(
        f"{len(same) - LISTED_NOTES} more frames: {what}, as of those before"
        for what, same in alike.items()
        if len(same) > LISTED_NOTES
    )
    return tuple(str(one) for same in alike.values() for one in same[:LISTED_NOTES]) + more


def _make_block(frames: Sequence[Frame], options: CloudOptions) -> tuple[CloudSet, list[CloudCounts]]:
    made = [make_or_report(frame, options) for frame in frames]
    return CloudSet.from_clouds([cloud for cloud, _ in made]), [counts for _, counts in made]
