"""Pairs registered beside those of the edge builders: in one piece from the poses, between two without a guess."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.global_pairs import describe_clouds, match_pairs
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.start.unordered.hypotheses import weigh
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import uses_images
from hodge_pipeline.start.unordered.views import Views
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, Source
from hodge_pipeline.types.notes import Note


@dataclass(frozen=True)
class Placed:
    """Poses (N, 4, 4) of all frames, each in its piece (N,)."""

    world_from_cam: Floats
    piece: Ints

    def across(self, pairs: Ints) -> Bools:
        """Where (P,) a pair lies in two pieces."""
        return np.asarray(self.piece[pairs[:, 0]] != self.piece[pairs[:, 1]])


def register_more(work: Work, title: str, proposed_by: str, pairs: Ints, placed: Placed) -> Edges:
    """The pairs (P, 2) registered as the recipe says, those of one piece first.

    A pair between two pieces is matched as the recipe's start matches without a guess, then registered from the match;
    without a match that it accepts it is left out, and reported.
    """
    matching = getattr(work.recipe.start, "unordered", work.recipe.start)
    matching = matching if isinstance(matching, GlobalStart) else GlobalStart()
    return work.steps.step(
        register_named_pairs, pairs, proposed_by, placed, work.scene.source, work.scene.clouds,
        work.recipe.registration, matching if placed.across(pairs).any() else None,
        title=title, total=len(pairs), workers=work.workers,
    )  # fmt: skip


def register_named_pairs(
    pairs: Ints,
    proposed_by: str,
    placed: Placed,
    source: Source,
    clouds: CloudSet,
    registrar: Registrar,
    matching: GlobalStart | None,
    *,
    workers: Workers,
    step: Step,
) -> Edges:
    """Step: these pairs registered, with `matching` between two pieces."""
    assert clouds.folder is not None
    across = placed.across(pairs)
    near, far = pairs[~across], pairs[across]
    i, j = near.T
    guesses = se3.inverse(placed.world_from_cam[i]) @ placed.world_from_cam[j]
    found = [register_pairs(clouds.folder, registrar, Edges.of(near), guesses, workers, step.advance)]
    if matching is not None:
        scratch = step.folder / "scratch"
        found.append(_without_guess(far, source, clouds.folder, registrar, matching, scratch, workers, step))
        step.advance(len(far))
    return Edges.joined(found).put(slice(None), proposed_by=proposed_by)


def _without_guess(
    pairs: Ints,
    source: Source,
    clouds: Path,
    registrar: Registrar,
    options: GlobalStart,
    scratch: Path,
    workers: Workers,
    step: Step,
) -> Edges:
    """Those of the pairs (P, 2) whose match is good enough to be judged with the other edges."""
    by_image = uses_images(CloudSet.open(clouds), options)
    matcher = options.images if by_image else options.registrar
    rows = np.unique(pairs)
    describe_clouds(clouds, matcher, rows, scratch, workers)
    matches = match_pairs(scratch, matcher, pairs, workers)
    views = Views.make([source.frames[row] for row in rows], scratch / "views", workers)
    found = weigh(
        clouds, matches, lambda row: views(int(np.searchsorted(rows, row))), registrar, options.limits, workers
    )
    shutil.rmtree(scratch, ignore_errors=True)
    if not found.counts.all():
        refused = ", ".join(f"{count} {reason}" for reason, count in found.rejected_counts.items())
        step.note(Note("matched", len(pairs), f"{int(found.counts.sum())} may be edges ({refused})"))
    return found.select(found.counts)
