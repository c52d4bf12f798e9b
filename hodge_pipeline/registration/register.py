"""The registration of a round's candidates as a step."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.seen_through import with_seen_through
from hodge_pipeline.registration.sliding import HELD_SPREADS, held_where_sliding, may_slide
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import HELD_OUT, REGISTERED, USED

REUSE_WITHIN_M = 0.01
"""Distance of a registration from its new guess below which it is reused: any registrar's basin is wider."""


def register_edges(
    edges: Edges,
    clouds: CloudSet,
    registrar: Registrar,
    world_from_cam: Floats,
    earlier: Edges | None = None,
    scale: float = 1.0,
    min_spread: float = 0.0,
    earlier_from: Floats | None = None,
    *,
    workers: Workers,
    step: Step,
) -> Edges:
    """Step: the table with its candidates registered from these poses; a killed run goes on at its last block.

    An `earlier` registration is kept where it needed no guess, where it is within `REUSE_WITHIN_M` of the guess from
    these poses, or, by GICP, where that guess is nearer to it than the earlier one, from `earlier_from (N, 4, 4)`:
    GICP would converge to it again. `scale` multiplies lengths; `min_spread`: see `Acceptance`.
    """
    held_out = edges.status == HELD_OUT
    candidates = edges.select(~held_out)
    guesses = se3.between(world_from_cam, candidates.pairs)
    before = guesses if earlier_from is None else se3.between(earlier_from, candidates.pairs)
    least = HELD_SPREADS * min_spread if isinstance(registrar, Gicp) else np.inf
    rows, known = _reusable(candidates, guesses, before, earlier, scale, least)
    missing = np.setdiff1d(np.arange(len(candidates)), rows)
    step.advance(len(rows))
    blocks = step.folder / "blocks"
    found = register_pairs(
        clouds.folder, registrar, candidates.select(missing), guesses[missing], workers, step.advance,
        finished={int(path.stem): artifacts.load(path, Edges) for path in sorted(blocks.glob("[0-9]*.npz"))},
        on_block=lambda block, result: keep_block(blocks, block, result),
    )  # fmt: skip
    shutil.rmtree(blocks, ignore_errors=True)
    found = held_where_sliding(found, guesses[missing], min_spread)
    kept = candidates.select(rows)
    if earlier is not None and len(rows):
        columns = {name: getattr(earlier, name)[known] for name in REGISTERED}
        kept = replace(kept, status=np.full(len(rows), USED), **columns)
    every = Edges.joined([found, kept]).select(np.argsort(np.concatenate([missing, rows])))
    unseen = np.flatnonzero(np.isnan(every.seen_through))  # what was kept has it, but for pairs of a start
    seen = with_seen_through(every.select(unseen), clouds, scale).seen_through
    return Edges.joined([every.put(unseen, seen_through=seen), edges.select(held_out)])


def keep_block(folder: Path, block: int, result: Edges) -> None:
    """Write one block of registered pairs, so that a killed registration goes on with the next one."""
    folder.mkdir(exist_ok=True)
    artifacts.save(folder / f"{block:06d}.npz", result)


def _reusable(
    candidates: Edges, guesses: Floats, before: Floats, earlier: Edges | None, scale: float, least_spread: float
) -> tuple[Ints, Ints]:
    """Rows of the candidates whose earlier registration is kept, and its rows in `earlier`.

    `guesses (P, 4, 4)` are the present ones, `before (P, 4, 4)` those that the earlier registration began at; being
    nearer than `before` counts only where the information holds translation by `least_spread` in every direction.
    """
    if earlier is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    unguessed = earlier.converged & (earlier.iterations == 0)
    standing = np.flatnonzero(unguessed | (earlier.status == USED))
    by_pair = dict(zip(map(tuple, earlier.pairs[standing].tolist()), standing.tolist(), strict=True))  # the last one's
    both = [(row, by_pair[a, b]) for row, (a, b) in enumerate(candidates.pairs.tolist()) if (a, b) in by_pair]
    rows, known = np.array(both, np.int64).reshape(-1, 2).T
    registered = earlier.select(known)
    apart = (se3.inverse(registered.i_from_j) @ where[rows] for where in (guesses, before))
    moved, moved_before = (se3.displacement_m(motions, se3.ARM_M * scale) for motions in apart)
    nearer = (moved < moved_before) & registered.converged & ~may_slide(registered, least_spread)
    kept = unguessed[known] | (moved < REUSE_WITHIN_M * scale) | nearer
    return rows[kept], known[kept]
