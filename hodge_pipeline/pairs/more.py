"""Pairs registered beside those of the edge builders: in one piece from the poses, between two without a guess."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.global_pairs import describe_clouds, match_pairs
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.rounds import Round
from hodge_pipeline.stages import Workers
from hodge_pipeline.start.unordered.hypotheses import weigh
from hodge_pipeline.start.unordered.start import uses_images
from hodge_pipeline.start.unordered.views import Views
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, Source


@dataclass(frozen=True)
class MoreRound:
    """A round that keeps the edges of the one before it, with the pairs that were `registered` for it alone, and the
    poses (N, 4, 4) they were registered from.
    """

    round: Round
    registered: Edges
    before: Floats


@dataclass(frozen=True)
class Placed:
    """Poses (N, 4, 4) of all frames, each in its piece (N,)."""

    world_from_cam: Floats
    piece: Ints

    def across(self, pairs: Ints) -> Bools:
        """Where (P,) a pair lies in two pieces."""
        return np.asarray(self.piece[pairs[:, 0]] != self.piece[pairs[:, 1]])


def register_more(
    job: Job,
    number: int,
    title: str,
    proposed_by: str,
    source: Source,
    pairs: Ints,
    placed: Placed,
    workers: Workers,
    inputs: tuple[str, ...],
) -> Edges:
    """Stage `register-<number>`: the pairs (P, 2) registered as the recipe says, those of one piece first.

    A pair between two pieces is matched as by the recipe's `global_start`, then registered from the match; without a
    match that it accepts it is left out, and said.
    """
    across = placed.across(pairs)
    near, far = pairs[~across], pairs[across]
    options = (job.recipe.registration, job.recipe.global_start if len(far) else None, pairs.tolist())
    with job.stage(f"register-{number}", title, len(pairs), options, ("clouds", *inputs)) as (folder, advance):
        if not folder.finished:
            i, j = near.T
            guesses = se3.inverse(placed.world_from_cam[i]) @ placed.world_from_cam[j]
            clouds, registrar = job.path("clouds"), job.recipe.registration
            found = [register_pairs(clouds, registrar, Edges.of(near), guesses, workers, advance)]
            if len(far):
                found.append(_without_guess(job, source, far, folder.path / "scratch", workers))
                advance(len(far))
            table = Edges.joined(found).put(slice(None), proposed_by=proposed_by)
            artifacts.save(folder.path / "edges.npz", table)
    return artifacts.load(job.path(f"register-{number}") / "edges.npz", Edges)


def _without_guess(job: Job, source: Source, pairs: Ints, scratch: Path, workers: Workers) -> Edges:
    """Those of the pairs (P, 2) whose match is good enough to be judged with the other edges."""
    options, folder = job.recipe.global_start, job.path("clouds")
    by_image = uses_images(CloudSet.open(folder), options)
    registrar = options.images if by_image else options.registrar
    rows = np.unique(pairs)
    describe_clouds(folder, registrar, rows, scratch, workers)
    matches = match_pairs(scratch, registrar, pairs, workers)
    views = Views.make([source.frames[row] for row in rows], scratch / "views", workers)
    found = weigh(
        folder, matches, lambda row: views(int(np.searchsorted(rows, row))), job.recipe.registration, options.limits,
        not by_image, workers,
    )  # fmt: skip
    shutil.rmtree(scratch, ignore_errors=True)
    if not found.counts.all():
        refused = ", ".join(f"{count} {reason}" for reason, count in found.rejected_counts.items())
        job.note(f"{len(pairs)} pairs between pieces matched, {int(found.counts.sum())} may be edges ({refused})")
    return found.select(found.counts)
