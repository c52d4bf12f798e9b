"""What a report holds: the run fills it, the tables, the plots and the page read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.types import Floats, Ints, ViewGraph
from hodge_pipeline.types.notes import Note


@dataclass(frozen=True)
class SourceSummary:
    """What was read: how many frames, how many of them with a true pose, and what the reader remarked.

    `key_frames` is None where every frame is a vertex of the graph. `kind` says what a frame is, `unordered` that all
    were joined from nothing.
    """

    name: str
    path: str
    frames: int
    frames_with_truth: int = 0
    sequences: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    key_frames: int | None = None
    kind: Literal["frames", "scans"] = "frames"
    unordered: bool = False

    @property
    def counted(self) -> str:
        """`600 frames`, or `600 frames, 54 of them key frames`."""
        keys = "" if self.key_frames is None else f", {self.key_frames} of them key frames"
        return f"{self.frames} {self.kind}{keys}"

    @property
    def vertex_name(self) -> str:
        """What the vertices of the viewing graph are."""
        return self.kind if self.key_frames is None else "key frames"


@dataclass(frozen=True)
class TrajectoryRow:
    """Absolute (ATE) and relative (RPE, over `rpe_delta_frames`) error of one set of poses against the truth."""

    name: str
    frames: int
    left_out: int
    ate_rmse_m: float
    ate_median_m: float
    ate_max_m: float
    rpe_translation_m: float
    rpe_rotation_deg: float
    degenerate: bool = False
    rpe_delta_frames: int = 1


@dataclass(frozen=True)
class LoopRow:
    """Loop deviation D after one inner iteration, summed over `loops` loops of a fixed basis."""

    iteration: str
    loops: int
    total: float

    @property
    def mean(self) -> float:
        """D of one loop on average, NaN without loops."""
        return self.total / self.loops if self.loops else float("nan")


@dataclass(frozen=True)
class EnergyRow:
    """The parts of ω before the solve of a round: how many vertices, edges and triangles its complex has, and the
    shares (rotation, translation) of the exact, co-exact and harmonic part in its energy.
    """

    round: str
    simplices: tuple[int, ...]
    exact: tuple[float, float]
    coexact: tuple[float, float]
    harmonic: tuple[float, float]
    rotation_rad2: float
    translation_m2: float


@dataclass(frozen=True)
class EdgeRow:
    """One measured edge and how far it is from the final poses; frames as the source names them."""

    i: str
    j: str
    source: str
    fitness: float
    weight: float
    residual_m: float
    residual_deg: float
    verdict: str = ""


@dataclass(frozen=True)
class ComponentRow:
    """The frames of one connected part of the viewing graph, in words (`0–120, 124`)."""

    count: int
    frames: str


@dataclass(frozen=True)
class GraphSummary:
    """The viewing graph in numbers: what it joins, where its edges come from, what was rejected and why, and how many
    edges the diagnosis judged how.
    """

    vertices: int
    edges: int
    edges_by_source: Mapping[str, int]
    components: tuple[ComponentRow, ...]
    edges_ignored: int = 0
    rejected: Mapping[str, int] = field(default_factory=dict)
    verdicts: Mapping[str, int] = field(default_factory=dict)
    verdicts_in_use: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class StageRow:
    """What one stage cost."""

    name: str
    wall_s: float
    cpu_s: float
    peak_mb: float


@dataclass(frozen=True)
class MeasureRow:
    """One quality of the poses before and after a refinement; `better` says which way is good."""

    name: str
    before: float
    after: float
    better: str
    unit: str
    is_worse: bool


@dataclass(frozen=True)
class RefinementSummary:
    """What became of a refinement: `outcome` is refined, optimal, worse or forced; why; and what it rests on."""

    outcome: str
    headline: str
    reason: str
    measures: tuple[MeasureRow, ...] = ()
    change: str = ""
    scale: str = ""


@dataclass(frozen=True)
class Path3D:
    """The positions (N, 3) of one set of poses, aligned to be compared; NaN where a frame has none."""

    name: str
    positions: Floats


@dataclass(frozen=True)
class Residuals:
    """Residuals (E,) of all edges under one set of poses, in metres and radians."""

    name: str
    translation_m: Floats
    angle_rad: Floats


@dataclass(frozen=True)
class Photograph:
    """A JPEG with its title and what it shows, in a sentence."""

    title: str
    caption: str
    jpeg: bytes


@dataclass(frozen=True)
class Pictures:
    """What the plots are drawn from; a plot without its data is left out.

    `component (N,)` breaks the paths between parts and sequences. `convergence` holds the objective after each
    iteration, one series for each solve. `sides` shows the scene before and after, `worst_pairs` the frames of the
    worst edges.
    """

    paths: tuple[Path3D, ...] = ()
    component: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    residuals: tuple[Residuals, ...] = ()
    graph: ViewGraph | None = None
    convergence: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    sides: tuple[Photograph, ...] = ()
    worst_pairs: tuple[Photograph, ...] = ()


@dataclass(frozen=True)
class Report:
    """Everything that `report.html` and `report.json` say about one run.

    `before` and `after` name the sets of poses that the verdict compares, as in `scores` and `trajectories`.
    `last_shift_m` is how far the last round moved the positions (root mean square), None where it had none before it.
    """

    title: str
    source: SourceSummary
    before: str = "odometry"
    after: str = "result"
    refinement: RefinementSummary | None = None
    scores: ScoreTable | None = None
    trajectories: tuple[TrajectoryRow, ...] = ()
    loops: tuple[LoopRow, ...] = ()
    energies: tuple[EnergyRow, ...] = ()
    graph: GraphSummary | None = None
    worst_edges: tuple[EdgeRow, ...] = ()
    stages: tuple[StageRow, ...] = ()
    notes: tuple[Note, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    recipe: str = ""
    last_shift_m: float | None = None
    pictures: Pictures = field(default_factory=Pictures)
