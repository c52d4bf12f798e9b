"""The photographs of a report: the merged clouds before and after, from four sides; the frames of the worst edges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.report import splat
from hodge_pipeline.report.contents import EdgeRow, Photograph
from hodge_pipeline.report.thumbnails import pair_of
from hodge_pipeline.types import CloudSet, Floats, Ints, Source

FRAMES = 200
"""Frames whose clouds are merged: more of them add nothing that is seen in a picture."""
EDGES = 6
GAP = 8


def four_sides(clouds: CloudSet, before: Floats, after: Floats, component: Ints) -> tuple[Photograph, ...]:
    """One picture for each side: the clouds laid together by the poses before on the left, after on the right.

    Only frames of the largest component, which both sets of poses (N, 4, 4) know; none where there is nothing to see.
    """
    finite = np.isfinite(before).all(axis=(1, 2)) & np.isfinite(after).all(axis=(1, 2))
    rows = np.flatnonzero(finite & (component == 0) & (clouds.sizes > 0))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), FRAMES)).round().astype(int))]
    if len(rows) < 2:
        return ()
    scenes = [splat.merged(clouds, poses, rows) for poses in (before, after)]
    gap = np.full((splat.HEIGHT, GAP, 3), splat.PAPER, np.uint8)
    return tuple(
        Photograph(
            f"From the {name}",
            "Before | after",
            splat.jpeg(np.hstack([splat.picture(scenes[0], stand), gap, splat.picture(scenes[1], stand)])),
        )
        for name, stand in splat.stands(scenes[1], after[rows]).items()
    )


def worst_pairs(source: Source, edges: Sequence[EdgeRow]) -> tuple[Photograph, ...]:
    """The two frames of each of the worst edges side by side; an edge whose images cannot be read has no picture."""
    return tuple(_worst_pairs(source, edges[:EDGES]))


def _worst_pairs(source: Source, edges: Sequence[EdgeRow]) -> Iterator[Photograph]:
    frames = {str(frame.frame_id): frame for frame in source.frames}
    for edge in edges:
        if edge.i not in frames or edge.j not in frames:
            continue
        try:
            image = pair_of(frames[edge.i], frames[edge.j])
        except (SourceError, OSError):
            continue
        if image is not None:
            ignored = ", ignored by the solver" if edge.weight <= 0 else ""
            caption = f"{edge.source}: off by {length(edge.residual_m)} and {edge.residual_deg:.2f}°{ignored}"
            yield Photograph(f"{edge.i} – {edge.j}", caption, splat.jpeg(image))
