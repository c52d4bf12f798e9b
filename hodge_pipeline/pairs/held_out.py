"""Held-out edges, by which the result of a solve is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.scene import Round
from hodge_pipeline.types import Bools, Edges, Ints
from hodge_pipeline.types.edges import HELD_OUT

HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd constants of a multiplicative hash: the draw depends on a pair's frames and the seed alone."""
FEWEST = 15
"""Fewest held-out pairs, where there are enough."""
LARGEST_SHARE = 0.3
"""Largest share of the pairs that is held out."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GuardOptions:
    """How a refinement is judged before it replaces the poses it started from."""

    held_out: float = Field(
        default=0.1,
        gt=0,
        lt=1,
        description="share of the overlapping pairs that are never registered: on them both sets of poses are scored",
    )
    shared_errors: float = Field(
        default=100.0,
        gt=0,
        description="times what edges leave over that they may err by, as errors that all edges of a frame share close "
        "every cycle: given poses that are no farther off keep their shape",
    )
    force: bool = Field(default=False, description="write the result even where it is worse by its own measures")


@plain_dataclass(frozen=True)
class HeldOut:
    """The share of pairs to keep out, and the seed that draws them."""

    share: float
    seed: int

    def of(self, candidates: Edges) -> Bools:
        """Where (P,) a pair is kept out: a share of those that no sequence needs, the same ones in every round.

        Of few pairs a larger share is kept out, up to `LARGEST_SHARE`.
        """
        mixed = candidates.pairs.astype(np.uint64) * HASH_FACTORS[:2]
        key = (mixed[:, 0] ^ (mixed[:, 1] >> np.uint64(7))) + np.uint64(self.seed) * HASH_FACTORS[2]
        key = (key ^ (key >> np.uint64(29))) * HASH_FACTORS[2]
        drawn = (key >> np.uint64(11)).astype(float) / float(1 << 53)
        needed = np.array(["sequential" in str(source).split("+") for source in candidates.proposed_by], bool)
        optional = ~needed.reshape(drawn.shape)
        wanted = min(LARGEST_SHARE, FEWEST / max(1, int(optional.sum())))
        return np.asarray((drawn < max(self.share, wanted)) & optional)


def held_out_pairs(rounds: Sequence[Round]) -> Ints:
    """The pairs (P, 2) that any round proposed and kept out, and that the last one did not register all the same."""
    kept = [one.edges.pairs[one.edges.status == HELD_OUT].tolist() for one in rounds]
    last = rounds[-1].edges
    found = {tuple(pair) for pairs in kept for pair in pairs}
    found -= set(map(tuple, last.pairs[last.status != HELD_OUT].tolist()))
    return np.array(sorted(found), np.int64).reshape(-1, 2)
