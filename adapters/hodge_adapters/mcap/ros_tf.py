"""The transforms of a recording: links between coordinate frames, static or in time, and chains of them."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from hodge_adapters.trajectories.text import ParsedTrajectory, ordered
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Trajectory
from hodge_pipeline.types.text import counted


@dataclass
class PoseColumns:
    """Stamps and poses as they come, in eight numbers each: an hour at 1 kHz is 230 MB, not gigabytes of objects."""

    numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp_s: float, pose: tuple[float, ...]) -> None:
        """Add one pose: translation and quaternion (x, y, z, qx, qy, qz, qw)."""
        self.numbers.append(stamp_s)
        self.numbers.extend(pose)

    def __len__(self) -> int:
        return len(self.numbers) // 8

    def ordered(self) -> ParsedTrajectory:
        """The poses by stamp, of several with one stamp the first, and what of them was not in order."""
        return ordered(np.array(self.numbers).reshape(-1, 8))


class TransformTree:
    """Each coordinate frame's motion in its parent's, looked up at any time.

    A link that was sent on a static topic, or only once, holds at all times, with the value sent last; others are
    interpolated.
    """

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_s = max_gap_s
        self._parent: dict[str, str] = {}
        self._links: dict[str, PoseColumns] = {}
        self._static: set[str] = set()
        self._trajectories: dict[str, Trajectory] = {}
        self.other_parents = 0
        """How many transforms were left out since their frame had another parent before."""
        self.replaced = 0
        """How many static transforms another one of the same link replaced, as tf2 has it."""

    def contents(self) -> tuple[str, ...]:
        """Its links, a line each, parents before children where the links form a tree."""
        return tuple(
            f"tf {parent} -> {child}: "
            + ("static" if child in self._static else counted(len(self._links[child]), "pose"))
            for child, parent in sorted(self._parent.items(), key=lambda link: (len(self._chain(link[0])), link))
        )

    def add(self, parent: str, child: str, stamp_s: float, pose: tuple[float, ...], *, is_static: bool) -> None:
        """Add `parent_from_child` at a stamp. Add all before the first look-up."""
        if self._parent.setdefault(child, parent) != parent:
            self.other_parents += 1
            return
        if is_static:
            self.replaced += child in self._static and self._links[child].numbers[1:].tolist() != list(pose)
            self._static.add(child)
        if child in self._static:
            self._links[child] = PoseColumns()
        self._links.setdefault(child, PoseColumns()).add(stamp_s, pose)

    def __contains__(self, frame: str) -> bool:
        return frame in self._parent or frame in self._parent.values()

    def moving(self) -> list[str]:
        """The frames that were sent in time, by name."""
        return sorted(frame for frame in self._links if not self._holds_always(frame))

    def root(self, frame: str) -> str:
        """The frame at the top of this one's chain."""
        return self._chain(frame)[-1]

    def lookup(self, target: str, source: str, stamps_s: Floats) -> Floats | None:
        """`target_from_source` (N, 4, 4) at the stamps, NaN where a link has none near; None where none links them."""
        up, down = self._chain(source), self._chain(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        common_from_source = self._down_from(up[: up.index(common)], stamps_s)
        common_from_target = self._down_from(down[: down.index(common)], stamps_s)
        return np.asarray(se3.inverse(common_from_target) @ common_from_source)

    def moving_stamps(self, target: str, source: str) -> Floats:
        """All stamps (N,) at which a link between two frames was sent, those of static links left out."""
        frames = set(self._chain(source)) ^ set(self._chain(target))
        stamps = [self._link(frame).stamps_s for frame in sorted(frames) if not self._holds_always(frame)]
        return np.unique(np.concatenate(stamps)) if stamps else np.zeros(0)

    def _chain(self, frame: str) -> list[str]:
        """The frames from this one up to the root, or until they repeat."""
        chain = [frame]
        while chain[-1] in self._parent and self._parent[chain[-1]] not in chain:
            chain.append(self._parent[chain[-1]])
        return chain

    def _down_from(self, frames: list[str], stamps_s: Floats) -> Floats:
        """The product of the links of these frames, from the last one's parent to the first frame."""
        product: Floats = np.broadcast_to(np.eye(4), (len(stamps_s), 4, 4)).copy()
        for frame in frames:
            link = self._link(frame)
            if self._holds_always(frame):
                product = np.asarray(link.world_from_cam[-1] @ product)
            else:
                product = np.asarray(se3.poses_at(link, stamps_s, self._max_gap_s) @ product)
        return product

    def _holds_always(self, frame: str) -> bool:
        return frame in self._static or frame not in self._links or len(self._link(frame)) == 1

    def _link(self, frame: str) -> Trajectory:
        if frame not in self._trajectories:
            self._trajectories[frame] = self._links[frame].ordered().trajectory
        return self._trajectories[frame]
