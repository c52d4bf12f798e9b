"""Does what docs/which-edge.md walks through, and draws its pictures: `python docs/make_which_edge.py runs/which-edge`.

With `--loops FILE` it writes the file of loop closures alone, three of them wrong, and prints the sequence's folder.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import hodge_pipeline
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, demo_source
from hodge_pipeline.diagnosis.result import WRONG
from hodge_pipeline.pairs.edits import Edit, History, write_history
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.report import raster
from hodge_pipeline.report.diagnosis_plots import draw
from hodge_pipeline.report.edge_pictures import edge_pictures
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.types import Floats, ViewGraph
from hodge_pipeline.uses.diagnosed import diagnose_subject, open_subject
from hodge_pipeline.uses.diagnosis_folder import write_diagnosed
from hodge_pipeline.uses.recipe_run import solve_again

PICTURES = Path(__file__).parent / "pictures"
RIGHT = ((2, 109), (6, 113), (10, 117))
"""Frames of the first and of the second time round that see the same corner."""
MISTAKEN = ((9, 63), (10, 64), (11, 65))
"""Frames that see the one desk, and frames that see the other, in the corner across."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""What moves the one desk onto the other: the room's middle is the origin, z is up."""


def write_loops(
    path: Path,
    source: Path,
    right: Sequence[tuple[int, int]] = RIGHT,
    mistaken: Sequence[tuple[int, int]] = MISTAKEN,
) -> None:
    """Loop closures as a place recogniser gives them, with noise, of one desk taken for the other in `mistaken`."""
    frames = TumReader().open(source)
    world_from_cam = true_poses(frames)
    pairs = np.array([*right, *mistaken])
    moved = world_from_cam[pairs[:, 1]]
    moved[len(right) :] = HALF_TURN @ moved[len(right) :]
    noise = se3.exp(np.array([0.004] * 3 + [0.005] * 3) * np.random.default_rng(0).normal(size=(len(pairs), 6)))
    measured = se3.inverse(world_from_cam[pairs[:, 0]]) @ moved @ noise
    information = np.tile(np.eye(6) / 0.003**2, (len(pairs), 1, 1))
    write_g2o(path, ViewGraph.from_edges(np.arange(len(frames.frames)), pairs, measured, information, source="loop"))


def from_above(path: Path, folder: Path, world_from_cam: Floats, view: raster.View | None) -> raster.View:
    """A picture of all clouds laid together by these poses, and where it was taken from."""
    clouds = Run.load(folder).clouds
    scene = raster.merged(clouds, world_from_cam, np.arange(len(clouds)))
    view = view or raster.around(scene, world_from_cam)["front"]
    path.write_bytes(raster.jpeg(raster.picture(scene, view)))
    return view


def stacked(path: Path, jpegs: list[bytes]) -> None:
    """Pictures of one width, or made so, under each other."""
    images = [Image.open(io.BytesIO(data)) for data in jpegs]
    width = min(image.width for image in images)
    images = [image.resize((width, round(image.height * width / image.width))) for image in images]
    canvas = Image.new("RGB", (width, sum(image.height + 8 for image in images) - 8), "white")
    top = 0
    for image in images:
        canvas.paste(image, (0, top))
        top += image.height + 8
    canvas.save(path, quality=85)


def main(folder: Path) -> None:
    """The run with the wrong loops, its diagnosis, the edit, the run without them; a picture of each."""
    folder.mkdir(parents=True, exist_ok=True)
    source, loops, run = demo_source(DemoOptions()), folder / "loops.g2o", folder / "run"
    write_loops(loops, source)
    options = [f"measured.files=[{{path: {loops}}}]", "edges={stage: sequential, reach: 3}", "outer_iterations=1"]
    options += ["solve_with=all", "solver.tails=gaussian", "start.revisits=null"]
    recipe = load_recipe("demo", [*options, "evaluation.tables=false"], source)
    if (run / "edges.csv").exists():
        write_history(run / "edits.json", History())
    doubled = hodge_pipeline.run(recipe, run).result.world_from_cam

    found = diagnose_subject(open_subject(run))
    write_diagnosed(folder / "why", found)
    print("\n".join(found.commands))
    rows = np.array([row for row in found.rows if found.subject.graph.source[row] != "sequential"][:1])
    (edge,) = edge_pictures(found.subject.graph, found.diagnosis, rows, found.subject.frames, found.subject.clouds)
    stacked(PICTURES / "which-edge-wrong.jpg", [plot.image for plot in edge.plots])
    matrix, above = draw(found.subject.graph, found.diagnosis, (), has_metres=True)
    (PICTURES / "which-edge-matrix.png").write_bytes(matrix.image)
    (PICTURES / "which-edge-above.png").write_bytes(above.image)

    names, graph = found.subject.graph.vertex_ids, found.subject.graph
    wrong = [names[graph.edges[row]] for row in found.rows if found.diagnosis.verdict[row] == WRONG]
    write_history(run / "edits.json", History((Edit(disable=tuple(f"{i}-{j}" for i, j in wrong)),)))
    single = solve_again(run).result.world_from_cam
    stand = from_above(PICTURES / "which-edge-single.jpg", run, single, None)
    from_above(PICTURES / "which-edge-doubled.jpg", run, doubled, stand)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("runs/which-edge"))
    parser.add_argument("--loops", type=Path, help="write the loop closures here and do nothing else")
    chosen = parser.parse_args()
    if chosen.loops:
        source = demo_source(DemoOptions())
        write_loops(chosen.loops, source)
        print(source)
    else:
        main(chosen.folder)
