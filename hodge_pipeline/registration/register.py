"""The registration of a round's candidates as a step."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pairs import (
    HELD_SPREADS,
    held_where_sliding,
    register_pairs,
    weak_directions,
)
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import HELD_OUT, MEASURED, USED

REUSE_WITHIN_M = 0.01
"""Between a registration and where the poses now put its pair: nearer than any registrar's start must be."""
SAME_START_M = 0.03
"""Between two starts of a pair, from which a registrar finds the same: a fifth of the 15 cm within which `rgbd` looks
for landmarks again, a third of what GICP forgives. Of the pairs of fr1/rpy and fr1/xyz that a second round started
anew so near, all ended within 9 mm of where they had, or failed again.
"""


def register_edges(
    edges: Edges,
    clouds: CloudSet,
    registrar: Registrar,
    world_from_cam: Floats,
    earlier: Edges | None = None,
    before: Floats | None = None,
    scale: float = 1.0,
    min_spread: float = 0.0,
    *,
    workers: Workers,
    step: Step,
) -> Edges:
    """Step: the table with its candidates registered from these poses; a killed run goes on at its last block.

    A pair that was registered `earlier`, without its guess, to where the poses put it still, or from nearly the same
    guess, by the poses `before (N, 4, 4)`, keeps what was found; lengths are multiplied by `scale`. `min_spread`: see
    `Acceptance`.
    """
    assert clouds.folder is not None
    held_out = edges.status == HELD_OUT
    candidates = edges.select(~held_out)
    i, j = candidates.pairs.T
    guesses = se3.inverse(world_from_cam[i]) @ world_from_cam[j]
    started = None if before is None else se3.inverse(before[i]) @ before[j]
    rows, known = _reusable(candidates, guesses, earlier, started, scale, min_spread)
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
        columns = {name: getattr(earlier, name)[known] for name in (*MEASURED, "iterations", "converged")}
        kept = replace(kept, status=np.full(len(rows), USED), **columns)
    order = np.argsort(np.concatenate([missing, rows]))
    return Edges.joined([Edges.joined([found, kept]).select(order), edges.select(held_out)])


def keep_block(folder: Path, block: int, result: Edges) -> None:
    """Write one block of registered pairs, so that a killed registration goes on with the next one."""
    folder.mkdir(exist_ok=True)
    artifacts.save(folder / f"{block:06d}.npz", result)


def _reusable(
    candidates: Edges, guesses: Floats, earlier: Edges | None, started: Floats | None, scale: float, min_spread: float
) -> tuple[Ints, Ints]:
    """Rows of the candidates whose earlier registration stands, and its rows in that table."""
    if earlier is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    by_pair = {(i, j): row for row, (i, j) in enumerate(earlier.pairs.tolist())}  # the last one's
    both = [(row, by_pair[i, j]) for row, (i, j) in enumerate(candidates.pairs.tolist()) if (i, j) in by_pair]
    rows, known = np.array(both, np.int64).reshape(-1, 2).T
    found, guesses = earlier.select(known), guesses[rows]
    stands = (found.status == USED) & (_apart_m(found.i_from_j, guesses, scale) < REUSE_WITHIN_M * scale)
    stands |= found.converged & (found.iterations == 0)
    if started is not None:
        held = weak_directions(found, HELD_SPREADS * min_spread)[0].any(axis=1)  # at the guess of then
        stands |= ~held & (_apart_m(started[rows], guesses, scale) < SAME_START_M * scale)
    return rows[stands], known[stands]


def _apart_m(one: Floats, other: Floats, scale: float) -> Floats:
    """How far apart motions (P, 4, 4) of pairs are, a turn as what it moves a point at the arm's length by."""
    apart = se3.log(se3.inverse(one) @ other)
    return np.asarray(np.linalg.norm(apart[:, 3:], axis=1) + se3.ARM_M * scale * np.linalg.norm(apart[:, :3], axis=1))
