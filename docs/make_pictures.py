"""Draws the pictures of docs/method.md with the code that they explain: `python docs/make_pictures.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from hodge_paper.embedding import Embedding, embed
from hodge_paper.rotation import angular_rotation, random_rotation
from hodge_pipeline.complex.cech import flag_complex
from hodge_pipeline.complex.decomposition import hodge_decomposition
from hodge_pipeline.types import Floats, Ints

HERE = Path(__file__).parent / "pictures"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#000000")
#      5 ---- 4
#    / | \  / | \
#   6  |  0   |  3
#    \ | /  \ | /
#      1 ---- 2
POSITIONS = np.array([[0, 0], [-1, -1], [1, -1], [2.1, 0], [1, 1], [-1, 1], [-2.1, 0]], float)
EDGES = np.array(
    [[0, 1], [0, 2], [0, 4], [0, 5], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [1, 6], [1, 5], [2, 4]], np.int64
)


def draw_graph(axis: Axes, positions: Floats, edges: Ints, labels: bool = True) -> None:
    """A graph as grey lines and numbered dots."""
    axis.add_collection(LineCollection(list(positions[edges]), colors="0.75", linewidths=1.2, zorder=1))
    axis.scatter(*positions.T, s=150 if labels else 12, color="white" if labels else "0.3", edgecolor="0.3", zorder=3)
    for vertex, (x, y) in enumerate(positions):
        if labels:
            axis.text(x, y, str(vertex), ha="center", va="center", fontsize=8, zorder=4)
    axis.set_aspect("equal")
    axis.axis("off")
    axis.margins(0.08)


def draw_cells(axis: Axes, positions: Floats, embedding: Embedding) -> None:
    """Each half-edge as a line to the left of its edge, in the colour of the cell that it bounds."""
    draw_graph(axis, positions, embedding.edges)
    for dart, cell in enumerate(embedding.cell_of_dart):
        edge = embedding.edges[dart // 2]
        start, end = positions[edge if dart % 2 == 0 else edge[::-1]]
        along = (end - start) / np.linalg.norm(end - start)
        beside = 0.09 * np.array([-along[1], along[0]])
        a, b = start + 0.26 * along + beside, end - 0.26 * along + beside
        style = {"arrowstyle": "-|>", "color": COLOURS[cell % len(COLOURS)], "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", xy=b, xytext=a, arrowprops=style, zorder=2)
    lengths = ", ".join(map(str, sorted(embedding.cells.lengths)))
    axis.text(0, -1.55, f"cells of {lengths} sides: F = {len(embedding.cells)}, g = {embedding.genus}", ha="center")


def draw_embeddings(path: Path) -> None:
    """A graph, its embedding by angle, and one by random orders."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6))
    draw_graph(axes[0], POSITIONS, EDGES)
    axes[0].set_title(f"the viewing graph: V = {len(POSITIONS)}, E = {len(EDGES)}")
    in_space = np.column_stack([POSITIONS, np.zeros(len(POSITIONS))])
    draw_cells(axes[1], POSITIONS, embed(EDGES, len(POSITIONS), angular_rotation(EDGES, in_space)))
    axes[1].set_title("orders by angle")
    draw_cells(axes[2], POSITIONS, embed(EDGES, len(POSITIONS), random_rotation(EDGES, seed=3)))
    axes[2].set_title("random orders")
    figure.tight_layout()
    figure.savefig(path, dpi=90, bbox_inches="tight")
    plt.close(figure)


def ring_with_a_hole() -> tuple[Floats, Ints]:
    """Positions and edges of a triangulated ring around a hole."""
    count = 12
    angle = 2 * np.pi * np.arange(count) / count
    rings = [
        radius * np.column_stack([np.cos(angle + turn), np.sin(angle + turn)])
        for radius, turn in ((1.0, 0.0), (1.55, np.pi / count), (2.3, 0.0))
    ]
    row = np.arange(count)
    after = (row + 1) % count
    edges = [np.stack([row + k * count, after + k * count], axis=1) for k in range(3)]
    edges += [np.stack([row, row + count], axis=1), np.stack([after, row + count], axis=1)]
    edges += [np.stack([row + count, row + 2 * count], axis=1), np.stack([row + count, after + 2 * count], axis=1)]
    return np.vstack(rings), np.vstack(edges)


def draw_parts(path: Path) -> None:
    """A form on the ring and its exact, co-exact and harmonic parts, as arrows along the edges."""
    positions, given = ring_with_a_hole()
    complex_ = flag_complex(given, len(positions))
    edges = complex_.simplices[1]
    i, j = edges.T
    middle, along = (positions[i] + positions[j]) / 2, positions[j] - positions[i]
    potential = 0.8 * positions[:, 0]
    around = np.stack([-middle[:, 1], middle[:, 0]], axis=1) / (middle**2).sum(axis=1, keepdims=True)
    eddy = middle - [0.0, 1.6]
    whirl = 2.5 * np.stack([-eddy[:, 1], eddy[:, 0]], axis=1) * np.exp(-1.5 * (eddy**2).sum(axis=1, keepdims=True))
    omega = potential[j] - potential[i] + ((0.7 * around + whirl) * along).sum(axis=1)
    parts = hodge_decomposition(complex_.coboundary(0), complex_.coboundary(1), omega[:, None], np.ones(len(edges)))
    shown = {
        "ω, what was measured": omega,
        "= exact: df\nwhat poses can absorb": parts.exact[:, 0],
        "+ co-exact: local disagreement,\nseen in triangles": parts.coexact[:, 0],
        "+ harmonic: a loop around the hole\nthat no triangle fills": parts.harmonic[:, 0],
    }
    figure, axes = plt.subplots(1, 4, figsize=(15, 4.6))
    for axis, (title, values) in zip(axes, shown.items(), strict=True):
        draw_graph(axis, positions, edges, labels=False)
        direction = along / np.linalg.norm(along, axis=1, keepdims=True) * values[:, None] * 0.7
        axis.quiver(
            *(middle - direction / 2).T, *direction.T, angles="xy", scale_units="xy", scale=1, width=0.009,
            color=COLOURS[1], zorder=3,
        )  # fmt: skip
        axis.set_title(title, fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=90, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    draw_embeddings(HERE / "embedding.png")
    draw_parts(HERE / "parts.png")
