"""Registration of named pairs: from the poses within a component, by global registration between two."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.global_pairs import describe_clouds, match_pairs
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.seen_through import with_seen_through
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
    """Poses (N, 4, 4) of all frames, each in its component `piece (N,)`."""

    world_from_cam: Floats
    piece: Ints

    def across(self, pairs: Ints) -> Bools:
        """Where (P,) a pair lies in two pieces."""
        return np.asarray(self.piece[pairs[:, 0]] != self.piece[pairs[:, 1]])

    def guesses(self, pairs: Ints, given: Floats | None = None) -> Floats:
        """The motions (P, 4, 4) `i_from_j` that are given or, where that is NaN, those of the poses; NaN for a pair
        that lies in two pieces.
        """
        poses = np.where(self.across(pairs)[:, None, None], np.nan, se3.between(self.world_from_cam, pairs))
        return poses if given is None else np.where(np.isnan(given), poses, given)


def register_more(
    work: Work, title: str, proposed_by: str, pairs: Ints, placed: Placed, guesses: Floats | None = None
) -> Edges:
    """The pairs (P, 2) registered as the recipe says, those of one piece first.

    A pair is registered from its guess (P, 4, 4), or from the poses where that is NaN. One between two pieces without a
    guess is matched as the recipe's start matches, then registered from the match; without a match that it accepts it
    is left out, and reported.
    """
    matching = getattr(work.recipe.start, "unordered", work.recipe.start)
    matching = matching if isinstance(matching, GlobalStart) else GlobalStart()
    guesses = placed.guesses(pairs, guesses)
    return work.steps.step(
        register_named_pairs, pairs, guesses, proposed_by, work.scene.source, work.scene.clouds,
        work.recipe.registration, matching if np.isnan(guesses).any() else None, work.scale,
        title=title, total=len(pairs), workers=work.workers,
    )  # fmt: skip


def register_named_pairs(
    pairs: Ints,
    guesses: Floats,
    proposed_by: str,
    source: Source,
    clouds: CloudSet,
    registrar: Registrar,
    matching: GlobalStart | None,
    scale: float,
    *,
    workers: Workers,
    step: Step,
) -> Edges:
    """Step: these pairs registered from their guesses (P, 4, 4), with `matching` where these are NaN.

    `scale` multiplies lengths that are for rooms.
    """
    unknown = np.asarray(np.isnan(guesses).any(axis=(1, 2)))
    near, far = pairs[~unknown], pairs[unknown]
    found = [register_pairs(clouds.folder, registrar, Edges.of(near), guesses[~unknown], workers, step.advance)]
    if matching is not None:
        scratch = step.folder / "scratch"
        found.append(_without_guess(far, source, clouds.folder, registrar, matching, scratch, workers, step))
        step.advance(len(far))
    every = Edges.joined(found).put(slice(None), proposed_by=proposed_by)
    return with_seen_through(every, clouds, scale)


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
    opened = CloudSet.open(clouds)
    by_image = uses_images(opened, options)
    matcher = options.images if by_image else options.registrar
    rows = np.unique(pairs)
    describe_clouds(clouds, matcher, rows, scratch, workers)
    matches = match_pairs(scratch, matcher, pairs, workers)
    views = Views.make(source.frames, opened, rows, scratch / "views", workers)
    found = weigh(clouds, matches, views, registrar, options.limits, workers)
    shutil.rmtree(scratch, ignore_errors=True)
    if not found.counts.all():
        refused = ", ".join(f"{count} {reason}" for reason, count in found.rejected_counts.items())
        step.note(Note("matched", len(pairs), f"{int(found.counts.sum())} may be edges ({refused})"))
    return found.select(found.counts)
