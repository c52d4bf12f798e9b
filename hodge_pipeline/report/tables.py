"""A report as rows of text: the same for the page and for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.evaluation.scores import CENTROID_DISTANCE_M, IOU, IOU_VOXEL_M, SIGMA_M, GraphScores
from hodge_pipeline.report import known_positions
from hodge_pipeline.report.contents import GRAPH_NAMES, RefinementSummary, Report
from hodge_pipeline.report.document import Table
from hodge_pipeline.types.text import counted


def score_tables(report: Report) -> Iterator[Table]:
    """Scores and trajectory errors of each set of poses, where they were measured."""
    if report.refinement is not None and report.refinement.measures:
        yield _measures(report.refinement, _of_key_frames(report))
        if report.refinement.candidates:
            yield _candidates(report.refinement)
    if report.scores is not None:
        yield _scores(report)
    if report.trajectories:
        yield _trajectories(report)
    if report.position_fit is not None:
        yield known_positions.table(report.position_fit)


def graph_tables(report: Report) -> Iterator[Table]:
    """The viewing graph, its parts where there are several, and the loop deviation."""
    if report.graph is not None:
        yield _graph(report)
        if len(report.graph.components) > 1:
            parts = tuple((str(n), str(part.count), part.frames) for n, part in enumerate(report.graph.components))
            header = ("part", report.source.vertex_name, "which")
            yield Table("Connected parts", header, parts, "Nothing measured joins two parts.", 3)
    if report.energies:
        yield _energies(report)
    if report.loops:
        yield _loops(report)


def _of_key_frames(report: Report) -> str:
    count = report.source.key_frames
    return "" if count is None else f"Of the {count} key frames. "


def _measures(refinement: RefinementSummary, of: str) -> Table:
    rows = tuple(
        (
            row.name,
            *(f"{value:.4g} {row.unit}".strip() for value in (row.before, row.after)),
            row.better,
            "worse" if row.is_worse else "ok",
        )
        for row in refinement.measures
    )
    header = ("measure", "before", "after", "better", "judgement")
    caption = f"{of}Where one is worse by more than its own noise the input is kept. "
    caption += " ".join(filter(None, (refinement.change, refinement.scale)))
    return Table("Measures", header, rows, caption)


def _candidates(refinement: RefinementSummary) -> Table:
    rows = tuple(
        (f"{name}{' (kept)' if row == refinement.kept else ''}", f"{cost.px:.4g}", f"{cost.median_px:.4g}",
         str(cost.behind), str(cost.distant), f"{cost.beyond:.2%}", str(len(cost.images_off)))
        for row, (name, cost) in enumerate(refinement.candidates)
    )  # fmt: skip
    header = ("candidate", "mean, px", "median, px", "behind", "distant", "beyond the cap", "images off")
    caption = (
        f"Each on the same {counted(refinement.candidates[0][1].observations, 'observation')}; a mean is of "
        "errors up to the cap. "
        "Lost or behind a camera, or distant (with no parallax where most candidates have one) counts as the cap."
    )
    return Table("Candidates", header, rows, caption)


def _scores(report: Report) -> Table:
    table = report.scores
    assert table is not None
    counts = ", ".join(counted_pairs(graph) for graph in table.graphs)
    columns = [(f"score, {GRAPH_NAMES[graph.kind]}", "d", "pairs") for graph in table.graphs]
    rows = [
        (name, *(cell for graph in table.graphs for cell in _score_cells(graph, row)))
        for row, name in enumerate(table.names)
    ]
    caption = _of_key_frames(report) + (
        f"How well overlapping clouds lie on each other, on the pairs of the {table.reference} poses ({counts}). "
        f"d: mean point-to-plane distance; score: mean of exp(−d / {table.scale * SIGMA_M * 1000:g} mm), 1 is perfect. "
        f"{' '.join(_kind_of_pairs(graph, table.scale) for graph in table.graphs)} "
        "Compare rows with each other: a score has no meaning alone."
    )
    return Table(
        "Scores",
        ("poses", *(cell for column in columns for cell in column)),
        tuple(rows),
        caption,
        highlighted=report.after,
    )


def _kind_of_pairs(graph: GraphScores, scale: float) -> str:
    """Which pairs a graph has, in a sentence."""
    if graph.kind == "distance":
        return f"Near-centroid pairs: clouds whose centroids lie less than {length(scale * CENTROID_DISTANCE_M)} apart."
    return f"Overlapping pairs: more than {IOU:.0%} of the voxels of both ({length(scale * IOU_VOXEL_M)}) are shared."


def counted_pairs(graph: GraphScores) -> str:
    """`355 overlapping pairs`."""
    name = GRAPH_NAMES[graph.kind]
    return f"{len(graph.pairs)} {name if len(graph.pairs) != 1 else name.removesuffix('s')}"


def _score_cells(graph: GraphScores, row: int) -> tuple[str, str, str]:
    score, distance, count = graph.mean_score[row], graph.mean_distance_m[row], graph.counts[row]
    return number(score, ".4f"), number(distance * 1000, ".2f", " mm"), str(count)


def _trajectories(report: Report) -> Table:
    header = ("poses", "ATE", "median", "largest", "RPE", "RPE, rotation", "frames")
    absolute_m = max((row.ate_rmse_m for row in report.trajectories if row.frames), default=0.0)
    floor = report.floor_m
    relative_m = max((row.rpe_translation_m for row in report.trajectories if row.frames), default=0.0)
    rows = tuple(
        (
            row.name,
            *(length(metres, absolute_m, floor) for metres in (row.ate_rmse_m, row.ate_median_m, row.ate_max_m)),
            length(row.rpe_translation_m, relative_m, floor),
            number(row.rpe_rotation_deg, ".3f", "°"),
            str(row.frames),
        )
        for row in report.trajectories
    )
    row = report.trajectories[0]
    of = "Distance" if row.of == "frames" else f"Of the {row.frames} {row.of}: distance"
    noun = row.of.split()[0].removesuffix("s")
    step = "next" if row.rpe_delta_frames == 1 else f"one {row.rpe_delta_frames} {noun}s on"
    caption = (
        f"{of} from the true positions after the best rigid alignment (ATE, root mean square), and error of the "
        f"motion from each {noun} to the {step} (RPE). The truth of a benchmark has errors of its own."
    )
    return Table("Trajectory", header, rows, caption, highlighted=report.after)


def _graph(report: Report) -> Table:
    graph = report.graph
    assert graph is not None
    rows = [
        (report.source.vertex_name, str(graph.vertices)),
        ("edges", str(graph.edges)),
        *((f"edges: {name}", str(count)) for name, count in graph.edges_by_source.items()),
        ("edges ignored by the solver", str(graph.edges_ignored)),
        *((f"edges judged {verdict}", str(count)) for verdict, count in graph.verdicts.items()),
        ("connected parts", str(len(graph.components))),
        *((f"pairs rejected: {reason}", str(count)) for reason, count in graph.rejected.items()),
    ]
    caption = "An edge is a measured motion between two frames; the word after `edges:` says what proposed the pair."
    return Table("Viewing graph", ("what", "count"), tuple(rows), caption)


def _energies(report: Report) -> Table:
    rows = tuple(
        (name, str(row.simplices[2]), *(f"{100 * part[0]:.1f} / {100 * part[1]:.1f} %" for part in row.shares.values()))
        for name, row in report.energies.items()
    )
    caption = (
        "What the edges say beyond the poses before each round's solve, "
        "ω = log(world_from_i · i_from_j · j_from_world), in Helmholtz–Hodge parts: shares of the energy, "
        "rotation / translation. Exact: what moving the poses takes away; co-exact: triangles that do not close; "
        "harmonic: longer loops that do not."
    )
    return Table("Decomposition", ("before", "triangles", "exact", "co-exact", "harmonic"), rows, caption, 5)


def _loops(report: Report) -> Table:
    rows = tuple((row.iteration, f"{row.mean:.3g}", f"{row.total:.3g}", str(row.loops)) for row in report.loops)
    caption = (
        "Deviation D of a loop: how far the product of motions along it is from the identity, ‖Π A − I‖, before the "
        "solve for the measured motions, then for the adjusted ones."
    )
    return Table("Loop deviation", ("after", "mean D of a loop", "sum", "loops"), rows, caption)


def source_table(report: Report) -> Table:
    """What was read."""
    source = report.source
    rows = [
        *((("format", source.format),) if source.format else ()),
        ("name", source.name),
        ("path", source.path),
        ("frames", str(source.frames)),
        *((("key frames", str(source.key_frames)),) if source.key_frames is not None else ()),
        ("frames with a true pose", str(source.frames_with_truth)),
        ("sequences", ", ".join(source.sequences) or "one"),
        *(("reader's remark", note) for note in source.notes),
    ]
    return Table("Input", ("what", "value"), tuple(rows), names=2)


def worst_edges_table(report: Report) -> Table:
    """The edges furthest from the result; without the columns of what nobody measured."""
    edges = report.worst_edges
    columns = {
        "i": [edge.i for edge in edges],
        "j": [edge.j for edge in edges],
        "source": [edge.source for edge in edges],
        "verdict": [edge.verdict or "–" for edge in edges],
        "why": [edge.why or "–" for edge in edges],
        "fitness": [number(edge.fitness, ".2f") for edge in edges],
        "weight": [number(edge.weight, ".2g") for edge in edges],
        "off by": [report.length(edge.residual_m, edges[0].residual_m) for edge in edges],
        "turned by": [number(edge.residual_deg, ".2f", "°") for edge in edges],
    }
    told = {
        "fitness": " Fitness: share of the cloud that found a partner.",
        "weight": " Weight: 0 where the solver ignored the edge.",
        "source": " Source: what proposed the pair.",
        "verdict": " Verdict: what the cycles through the edge say.",
    }
    if any("backbone" in edge.why for edge in edges):
        told["why"] = " Backbone: consecutive edges that are trusted as a whole, as an odometry."
    header = tuple(name for name, cells in columns.items() if set(cells) != {"–"})
    rows = tuple(zip(*(columns[name] for name in header), strict=True))
    caption = "Measured motions that disagree most with the result, worst first: a wrong edge, or a wrong result there."
    caption += " edges.csv has all." + "".join(told.get(name, "") for name in header)
    words = sum(name in ("i", "j", "source", "verdict", "why") for name in header)
    wide = tuple(column for column, name in enumerate(header) if name == "why")
    return Table("Worst edges", header, rows, caption, words, wide=wide)


def stages_table(report: Report) -> Table:
    """What each stage cost, with the total."""
    stages = (*report.stages, *filter(None, [report.total]))
    rows = tuple((s.name, f"{s.wall_s:.1f} s", f"{s.cpu_s:.1f} s", number(s.peak_mb, ".0f", " MB")) for s in stages)
    caption = "CPU time and peak memory are summed over all processes; a stage that was resumed cost nothing."
    return Table("Time", ("stage", "wall", "CPU", "peak memory"), rows, caption)


def number(value: float, form: str, unit: str = "") -> str:
    """A number in this form, a dash where it is not finite."""
    return f"{value:{form}}{unit}".replace("-", "−") if np.isfinite(value) else "–"
