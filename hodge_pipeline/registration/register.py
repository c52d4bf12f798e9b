"""The registration of a round's candidates as a step."""

from __future__ import annotations

from hodge_pipeline import se3
from hodge_pipeline.registration.block_store import BlockStore
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.types import CloudSet, Edges, Floats
from hodge_pipeline.types.edges import HELD_OUT


def register_edges(
    edges: Edges, clouds: CloudSet, registrar: Registrar, world_from_cam: Floats, *, workers: Workers, step: Step
) -> Edges:
    """Step: the table with its candidates registered from these poses; a killed run goes on at its last block."""
    assert clouds.folder is not None
    held_out = edges.status == HELD_OUT
    candidates = edges.select(~held_out)
    i, j = candidates.pairs.T
    guesses = se3.inverse(world_from_cam[i]) @ world_from_cam[j]
    blocks = BlockStore(step.folder / "blocks")
    found = register_pairs(
        clouds.folder, registrar, candidates, guesses, workers, step.advance,
        finished=blocks.read(), on_block=blocks.write,
    )  # fmt: skip
    blocks.remove()
    return Edges.joined([found, edges.select(held_out)])
