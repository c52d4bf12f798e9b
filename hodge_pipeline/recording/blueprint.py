"""The default blueprint (layout of the viewer): a tab for each stage of a run."""

from __future__ import annotations

from dataclasses import dataclass

import rerun.blueprint as rrb

from hodge_pipeline.recording import layout
from hodge_pipeline.recording.eye import Eye, Eyes
from hodge_pipeline.types.text import markdown_table

BACKGROUND = (24, 26, 32)
STORY_TAB = "Story"
COLOUR_NAMES = {"truth": "green", "odometry": "orange", "start": "violet"}


@dataclass(frozen=True)
class Contents:
    """What a recording holds: stages and trajectories by name, the best trajectory, the last rounds (0: none), whether
    its poses are a scanner's, and the paths of its entities.
    """

    stages: frozenset[str] = frozenset()
    trajectories: tuple[str, ...] = ()
    trajectory: str = "truth"
    last_graph: int = 0
    last_solution: int = 0
    is_scanner: bool = False
    entities: frozenset[str] = frozenset()

    @property
    def pairs(self) -> tuple[str, ...]:
        """The names of the pairs whose clouds are shown."""
        return tuple(sorted({path.split("/")[2] for path in self.entities if path.startswith(f"{layout.PAIRS}/")}))

    def holds(self, parent: str) -> bool:
        """Whether there is this entity, or one below it."""
        return any(path == parent or path.startswith(f"{parent}/") for path in self.entities)


def make_blueprint(contents: Contents, eyes: Eyes, opened: str = STORY_TAB) -> rrb.Blueprint:
    """The default blueprint: a tab for each part of the run that is there; it opens on the one of this name."""
    tabs = make_tabs(contents, eyes)
    at = [tab.name for tab in tabs].index(opened)
    return without_panels(rrb.Tabs(*tabs, active_tab=at), layout.STORY)


def without_panels(root: rrb.Container, timeline: str) -> rrb.Blueprint:
    """A blueprint whose panels are closed; no time panel at all without a timeline."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline) if timeline else rrb.TimePanel(state="hidden"),
        auto_views=False,
    )


def make_tabs(contents: Contents, eyes: Eyes) -> list[rrb.Container]:
    """The tabs in the order of the run."""
    has_pairs = {"registration", "diagnosis"} & contents.stages
    return [
        _story_tab(contents, eyes.room),
        *([_frames_tab(contents, eyes.room)] if contents.holds(layout.CAMERA) else []),
        *([registration_tab(contents, eyes.pair)] if "registration" in contents.stages else []),
        *([complex_tab(contents, eyes.graph)] if has_pairs else []),
        _solver_tab(contents, eyes.graph),
        *([model_tab(eyes.room)] if "model" in contents.stages else []),
        *([evaluation_tab(contents, eyes.graph)] if "evaluation" in contents.stages else []),
        _text_tab(),
    ]


def scene_view(name: str, contents: list[str], eye: Eye | None, origin: str = layout.WORLD) -> rrb.Spatial3DView:
    """A view of the world with these entities, seen from `eye` where one is given."""
    controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up) if eye else None
    return rrb.Spatial3DView(
        origin=origin,
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
    scene = scene_view("Model, trajectories and edges", shown + _lines(contents.trajectory), eye)
    side = rrb.Vertical(
        *_images(contents, layout.COLOUR),
        *_errors_views(contents),
        rrb.Tabs(
            rrb.TextDocumentView(origin=layout.LEGEND, name="Colours"),
            rrb.TextDocumentView(origin=layout.graph_text(max(contents.last_graph, 1)), name="Viewing graph"),
        ),
    )
    return rrb.Horizontal(scene, side, column_shares=[3, 1], name=STORY_TAB)


def _images(contents: Contents, *paths: str) -> list[rrb.Spatial2DView]:
    """A view of each of these images that there is."""
    names = {layout.COLOUR: "Colour", layout.DEPTH: "Depth"}
    return [
        rrb.Spatial2DView(origin=layout.PINHOLE, name=names[path], contents=[f"+ {path}"])
        for path in paths
        if contents.holds(path)
    ]


def _frames_tab(contents: Contents, eye: Eye | None) -> rrb.Container:
    shown = [f"+ {layout.CAMERA}/**", f"- {layout.DEPTH}", f"+ {layout.trajectory(contents.trajectory)}"]
    scene = scene_view("One scan" if contents.is_scanner else "Camera and its cloud", shown, eye)
    images = _images(contents, layout.COLOUR, layout.DEPTH)
    if not images:
        return rrb.Horizontal(scene, name="Frames")
    return rrb.Horizontal(scene, rrb.Vertical(*images), column_shares=[2, 1], name="Frames")


def _solver_tab(contents: Contents, eye: Eye | None) -> rrb.Vertical:
    rejected = [f"+ {layout.rejected(contents.last_graph)}"] if contents.last_graph else []
    graphs = rrb.Horizontal(
        scene_view("Solve: edges by residual", [f"+ {layout.FILM}/**"], eye),
        scene_view("As measured, with rejected pairs", [f"+ {layout.edges(contents.last_graph)}", *rejected], eye),
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


def registration_tab(contents: Contents, eye: Eye | None) -> rrb.Vertical:
    """Chosen pairs before and after, and the numbers of all."""
    views = [
        scene_view(
            f"{name.replace('_', ' ').capitalize()}, {when}",
            [f"+ {layout.pair(name)}/target", f"+ {layout.pair(name)}/{when}"],
            eye,
            layout.pair(name),
        )
        for when in ("before", "after")
        for name in contents.pairs
    ]
    outer = max(contents.last_graph, 1)
    bars = [
        rrb.BarChartView(origin=layout.under(layout.BARS, f"{name}_round_{outer}"), name=title)
        for name, title in (("fitness", "Fitness of all pairs"), ("rmse_mm", "RMSE of all pairs, mm"))
    ]
    numbers = rrb.Horizontal(rrb.TextDocumentView(origin=layout.PAIRS_TEXT, name="Pairs"), *bars)
    return rrb.Vertical(
        rrb.Grid(*views, grid_columns=max(len(contents.pairs), 1)), numbers, row_shares=[3, 1], name="Registration"
    )


def complex_tab(contents: Contents, eye: Eye | None) -> rrb.Horizontal:
    """The triangles by curl, and the verdicts on the edges."""
    outer = max(contents.last_solution, 1)
    eye = eye and eye.from_afar(1.7)
    trajectory = f"+ {layout.trajectory(contents.trajectory)}"
    scenes = [scene_view("Triangles by curl", [f"+ {layout.complex_mesh(outer)}", trajectory], eye)]
    texts = [rrb.TextDocumentView(origin=layout.complex_text(outer), name="Complex")]
    if "diagnosis" in contents.stages:
        scenes.append(scene_view("Which edge is wrong", [f"+ {layout.VERDICTS}/**", trajectory], eye))
        texts.append(rrb.TextDocumentView(origin=layout.DIAGNOSIS, name="Verdicts"))
    return rrb.Horizontal(
        *scenes, rrb.Vertical(*texts), column_shares=[2] * len(scenes) + [1], name="Complex, diagnosis"
    )


def model_tab(eye: Eye | None) -> rrb.Horizontal:
    """The model as it grows frame by frame, beside the whole of it."""
    eye = eye and eye.from_afar(1.25)
    growing = [f"+ {layout.GROWTH}/**", f"+ {layout.CAMERA}/**", f"- {layout.CLOUD}", f"- {layout.DEPTH}"]
    return rrb.Horizontal(
        scene_view("As it grows (timeline frame)", growing, eye),
        scene_view("Whole", [f"+ {layout.MODEL}"], eye),
        name="Model",
    )


def evaluation_tab(contents: Contents, eye: Eye | None) -> rrb.Horizontal:
    """Truth, odometry and result together, and the errors frame by frame."""
    scene = scene_view(
        "Trajectories",
        [f"+ {layout.trajectory(name)}" for name in contents.trajectories] + _lines(contents.trajectory),
        eye,
    )
    plots = rrb.Vertical(
        *_errors_views(contents),
        *_series(contents, layout.FRAME_PLOTS, "score", "Score of a frame's pairs"),
        *_series(contents, layout.SOLVER_PLOTS, "loop_deviation_mean", "Deviation D of a loop"),
    )
    scores = rrb.TextDocumentView(origin=layout.SCORES, name="Scores")
    return rrb.Horizontal(
        scene, rrb.Vertical(plots, scores, row_shares=[3, 1]), column_shares=[3, 2], name="Evaluation"
    )


def _errors_views(contents: Contents) -> list[rrb.TimeSeriesView]:
    return _series(contents, layout.FRAME_PLOTS, "error_m", "Error of the position (ATE), m")


def _series(contents: Contents, origin: str, path: str, name: str) -> list[rrb.TimeSeriesView]:
    """A view of these series, where there are any."""
    view = rrb.TimeSeriesView(origin=origin, name=name, contents=[f"+ $origin/{path}/**"])
    return [view] if contents.holds(f"{origin}/{path}") else []


def _text_tab() -> rrb.Horizontal:
    documents = [rrb.TextDocumentView(origin=layout.RECIPE, name="Recipe")]
    documents += [rrb.TextDocumentView(origin=layout.SOURCE, name="Source")]
    log = rrb.TextLogView(origin=layout.LOG, name="Log")
    return rrb.Horizontal(rrb.Tabs(*documents), log, name="Log and recipe")


def legend(contents: Contents) -> str:
    """What the colours mean, as Markdown."""
    rows = [("white", f"the result, {contents.trajectory.replace('_', ' ')}")] if contents.last_solution else []
    rows += [(colour, name) for name, colour in COLOUR_NAMES.items() if name in contents.trajectories]
    if "diagnosis" in contents.stages:
        rows += [
            ("blue, grey, amber, magenta", "in the diagnosis: an edge that is consistent, untestable, suspect, wrong")
        ]
    if contents.last_graph or contents.last_solution:
        rows += [("blue to yellow", "an edge: the brighter, the larger its residual")]
        rows += [("magenta", "an edge that the solver ignored"), ("grey", "a candidate pair that became no edge")]
    return markdown_table(("colour", "what"), rows)
