"""Where the blocks of a registration in progress are kept."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Edges


@dataclass(frozen=True)
class BlockStore:
    """Registered blocks on disk, so that a killed registration goes on with the next one."""

    folder: Path

    def read(self) -> dict[int, Edges]:
        """The blocks that are there, by number."""
        return {int(path.stem): artifacts.load(path, Edges) for path in sorted(self.folder.glob("[0-9]*.npz"))}

    def write(self, block: int, result: Edges) -> None:
        """Keep one block."""
        self.folder.mkdir(exist_ok=True)
        artifacts.save(self.folder / f"{block:06d}.npz", result)

    def remove(self) -> None:
        """Forget the blocks: the whole is written."""
        shutil.rmtree(self.folder, ignore_errors=True)
