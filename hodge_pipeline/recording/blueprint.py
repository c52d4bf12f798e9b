"""How the viewer opens: on the story, with frames, solver and log in tabs beside it."""

from __future__ import annotations

from dataclasses import dataclass

import rerun.blueprint as rrb

from hodge_pipeline.recording import layout
from hodge_pipeline.recording.eye import Eye

BACKGROUND = (24, 26, 32)
COLOUR_NAMES = {"truth": "green", "odometry": "orange", "start": "orange"}


@dataclass(frozen=True)
class Contents:
    """What a recording holds: stages and trajectories by name, the best trajectory, the last rounds (0: none)."""

    stages: frozenset[str] = frozenset()
    trajectories: tuple[str, ...] = ()
    trajectory: str = "truth"
    last_graph: int = 0
    last_solution: int = 0


def make_blueprint(contents: Contents, room: Eye | None, graph: Eye | None) -> rrb.Blueprint:
    """The default blueprint: four tabs, the story first, its timeline the one that all data share.

    `room` sees the model, `graph` the cameras alone.
    """
    tabs = rrb.Tabs(
        _story_tab(contents, room),
        _frames_tab(contents, room),
        _solver_tab(contents, graph),
        _text_tab(contents),
        active_tab=0,
    )
    return rrb.Blueprint(
        tabs,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=layout.STORY),
        auto_views=False,
    )


def _scene(name: str, contents: list[str], eye: Eye | None) -> rrb.Spatial3DView:
    controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up) if eye else None
    return rrb.Spatial3DView(
        origin=layout.WORLD,
        name=name,
        contents=contents,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=controls,
    )


def _lines(name: str) -> list[str]:
    return [f"+ {layout.trajectory(name)}", f"+ {layout.frusta(name)}"]


def _edges(contents: Contents) -> str:
    if contents.last_solution and contents.last_solution >= contents.last_graph:
        return layout.solved_edges(contents.last_solution)
    return layout.edges(contents.last_graph)


def _story_tab(contents: Contents, eye: Eye | None) -> rrb.Horizontal:
    shown = [
        f"+ {layout.MODEL}",
        f"+ {_edges(contents)}",
        f"+ {layout.CAMERA}/**",
        f"- {layout.CLOUD}",
        f"- {layout.DEPTH}",
    ]
    shown += [f"+ {layout.trajectory(name)}" for name in contents.trajectories]
    scene = _scene("Room, trajectories and edges", shown + _lines(contents.trajectory), eye)
    side = rrb.Vertical(
        rrb.Spatial2DView(origin=layout.PINHOLE, name="Colour", contents=[f"+ {layout.COLOUR}"]),
        rrb.TimeSeriesView(origin=layout.FRAME_PLOTS, name="Scores of the frames"),
        rrb.Tabs(
            rrb.TextDocumentView(origin=layout.LEGEND, name="Colours"),
            rrb.TextDocumentView(origin=layout.graph_text(max(contents.last_graph, 1)), name="Viewing graph"),
        ),
    )
    return rrb.Horizontal(scene, side, column_shares=[3, 1], name="Story")


def _frames_tab(contents: Contents, eye: Eye | None) -> rrb.Horizontal:
    images = rrb.Vertical(
        rrb.Spatial2DView(origin=layout.PINHOLE, name="Colour", contents=[f"+ {layout.COLOUR}"]),
        rrb.Spatial2DView(origin=layout.PINHOLE, name="Depth", contents=[f"+ {layout.DEPTH}"]),
    )
    shown = [f"+ {layout.CAMERA}/**", f"- {layout.DEPTH}", f"+ {layout.trajectory(contents.trajectory)}"]
    return rrb.Horizontal(_scene("Camera and its cloud", shown, eye), images, column_shares=[2, 1], name="Frames")


def _solver_tab(contents: Contents, eye: Eye | None) -> rrb.Vertical:
    rejected = [f"+ {layout.rejected(contents.last_graph)}"] if contents.last_graph else []
    graphs = rrb.Horizontal(
        _scene("Solve: edges by residual", [f"+ {layout.FILM}/**"], eye),
        _scene("As measured, with rejected pairs", [f"+ {layout.edges(contents.last_graph)}", *rejected], eye),
    )
    plots = rrb.Horizontal(
        *(
            rrb.TimeSeriesView(origin=layout.SOLVER_PLOTS, name=name, contents=[f"+ $origin/{path}" for path in paths])
            for name, paths in (("Residual", ("residual_mean_m", "residual_95th_m")), ("Objective", ("objective",)))
        ),
        rrb.TimeSeriesView(
            origin=layout.SOLVER_PLOTS,
            name="All else",
            contents=["+ $origin/**", "- $origin/objective", "- $origin/residual_mean_m", "- $origin/residual_95th_m"],
        ),
    )
    return rrb.Vertical(graphs, plots, row_shares=[3, 1], name="Edges and solver")


def _text_tab(contents: Contents) -> rrb.Horizontal:
    documents = [rrb.TextDocumentView(origin=layout.RECIPE, name="Recipe")]
    documents += [rrb.TextDocumentView(origin=layout.SOURCE, name="Source")]
    documents += [rrb.TextDocumentView(origin=layout.SCORES, name="Scores")]
    log = rrb.TextLogView(origin=layout.LOG, name="Log")
    charts = rrb.BarChartView(origin=layout.BARS, name="Bar charts")
    right = rrb.Vertical(log, charts) if "evaluation" in contents.stages else log
    return rrb.Horizontal(rrb.Tabs(*documents), right, name="Log and recipe")


def legend(contents: Contents) -> str:
    """What the colours mean, as Markdown."""
    lines = ["| colour | what |", "|---|---|"]
    lines += [f"| white | the result, {contents.trajectory.replace('_', ' ')} |"] if contents.last_solution else []
    lines += [f"| {colour} | {name} |" for name, colour in COLOUR_NAMES.items() if name in contents.trajectories]
    if contents.last_graph or contents.last_solution:
        lines += ["| blue to yellow | an edge: the brighter, the larger its residual |"]
        lines += ["| magenta | an edge that the solver ignored |", "| grey | a candidate pair that became no edge |"]
    return "\n".join(lines)
