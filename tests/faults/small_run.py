"""A run so small that hundreds can be broken: 6 frames of 80 x 60, its undisturbed result, and what must be equal."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import hodge_pipeline
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.pairs.edits import Edit, History, write_history
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.run_folder import Run
from hodge_pipeline.uses.recipe_run import solve_again

SMALL = (
    "clouds.voxel_m=0.1", "executor={stage: local, workers: 0}", "recording.level=off", "evaluation.tables=false",
    "outer_iterations=1", "acceptance.min_fitness=0.05", "start.min_fitness=0.05", "fusion=[]",
)  # fmt: skip
HEALED = "is computed again"
"""What a note of a step that was damaged says: it is the only difference that damage may make."""
OWN_TIME = ("log.txt",)
"""Files that say when, and so differ between any two runs."""


@dataclass(frozen=True)
class Outcome:
    """What two runs of one recipe must have in common, to the bit."""

    poses: bytes
    notes: tuple[str, ...]
    edges: str
    listing: tuple[str, ...]

    @classmethod
    def of(cls, folder: Path) -> Outcome:
        """Of a finished run folder."""
        run = Run.load(folder)
        notes = tuple(str(note) for note in run.report.notes if HEALED not in str(note))
        files = tuple(sorted(str(path.relative_to(folder)) for path in folder.rglob("*")))
        return cls(np.ascontiguousarray(run.poses).tobytes(), notes, (folder / "edges.csv").read_text("utf-8"), files)

    def differences(self, other: Outcome) -> list[str]:
        """What is not equal, in words."""
        found = [
            f"{name} differ" for name in ("poses", "notes", "edges") if getattr(self, name) != getattr(other, name)
        ]
        gone, left = set(self.listing) - set(other.listing), set(other.listing) - set(self.listing)
        return [*found, *(f"{name} is gone" for name in sorted(gone)), *(f"{name} stays" for name in sorted(left))]


@dataclass(frozen=True)
class Made:
    """The source, a finished run of it, and one that was edited, in a scratch folder of this process."""

    source: Path
    run: Path
    edited: Path

    @property
    def recipe(self) -> Recipe:
        """The recipe of both."""
        return recipe(self.source)


def recipe(source: Path, *more: str) -> Recipe:
    """The demo's recipe for six small frames."""
    return load_recipe("demo", [*SMALL, *more], source)


@cache
def made(scratch: Path) -> Made:
    """Make all three, once in a scratch folder whichever process comes first."""
    source = make_sequence(scratch / "source", DemoOptions(frames=6, width=80, height=60, turns=0.02))
    run, edited = scratch / "run", scratch / "edited"
    if not (scratch / "made").exists():
        shutil.rmtree(run, ignore_errors=True)
        shutil.rmtree(edited, ignore_errors=True)
        image = max((source / "rgb").iterdir())
        image.write_bytes(image.read_bytes()[:40])  # the step of the clouds has a note, which a resumed run must keep
        hodge_pipeline.run(recipe(source), run)
        shutil.copytree(run, edited)
        edit(edited)
        solve_again(edited)
        (scratch / "made").touch()
    return Made(source, run, edited)


def edit(folder: Path) -> None:
    """Switch the first edge off."""
    first = (folder / "edges.csv").read_text("utf-8").splitlines()[1].split(",")
    write_history(folder / "edits.json", History((Edit(disable=(f"{first[0]}-{first[1]}",)),)))
