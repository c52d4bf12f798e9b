"""The registration of a round's candidates as a step."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.pairs import HELD_SPREADS, held_where_sliding, register_pairs, weak_directions
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import HELD_OUT, REGISTERED, USED

REUSE_WITHIN_M = 0.01
"""Between a registration and where the poses now put its pair: nearer than any registrar's start must be."""


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

    A pair that was registered `earlier`, without its guess or to where the poses put it still, keeps that registration;
    lengths are multiplied by `scale`. `min_spread`: see `Acceptance`. By GICP it also keeps one that the poses lie
    nearer to than `earlier_from (N, 4, 4)` did, from which it was registered: its descent leads there again.
    """
    assert clouds.folder is not None
    held_out = edges.status == HELD_OUT
    candidates = edges.select(~held_out)
    i, j = candidates.pairs.T
    guesses = se3.inverse(world_from_cam[i]) @ world_from_cam[j]
    before = guesses if earlier_from is None else se3.inverse(earlier_from[i]) @ earlier_from[j]
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
    order = np.argsort(np.concatenate([missing, rows]))
    return Edges.joined([Edges.joined([found, kept]).select(order), edges.select(held_out)])


def keep_block(folder: Path, block: int, result: Edges) -> None:
    """Write one block of registered pairs, so that a killed registration goes on with the next one."""
    folder.mkdir(exist_ok=True)
    artifacts.save(folder / f"{block:06d}.npz", result)


def _reusable(
    candidates: Edges, guesses: Floats, before: Floats, earlier: Edges | None, scale: float, least_spread: float
) -> tuple[Ints, Ints]:
    """Rows of the candidates whose earlier registration stands, and its rows in that table: one that the guesses
    (P, 4, 4) lie near to, or nearer than those of `before (P, 4, 4)`, and whose clouds hold each other by
    `least_spread` in all directions.
    """
    if earlier is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    unguessed = earlier.converged & (earlier.iterations == 0)
    standing = np.flatnonzero(unguessed | (earlier.status == USED))
    by_pair = dict(zip(map(tuple, earlier.pairs[standing].tolist()), standing.tolist(), strict=True))  # the last one's
    both = [(row, by_pair[a, b]) for row, (a, b) in enumerate(candidates.pairs.tolist()) if (a, b) in by_pair]
    rows, known = np.array(both, np.int64).reshape(-1, 2).T
    registered = earlier.select(known)
    moved, moved_before = (_apart(registered, where[rows], scale) for where in (guesses, before))
    nearer = (moved < moved_before) & registered.converged & _is_held(registered, least_spread)
    kept = unguessed[known] | (moved < REUSE_WITHIN_M * scale) | nearer
    return rows[kept], known[kept]


def _apart(registered: Edges, i_from_j: Floats, scale: float) -> Floats:
    """How far (P,) motions (P, 4, 4) lie from those registered, turns at an arm's length."""
    twist = se3.log(se3.inverse(registered.i_from_j) @ i_from_j)
    return np.asarray(np.linalg.norm(twist[:, 3:], axis=1) + se3.ARM_M * scale * np.linalg.norm(twist[:, :3], axis=1))


def _is_held(registered: Edges, least_spread: float) -> Bools:
    """Where (P,) no direction is one that the two clouds may slide in."""
    weak, _ = weak_directions(registered, least_spread)
    return np.asarray(~weak.any(axis=1))
