"""What a report holds: the run fills it, the tables, the plots and the page read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.evaluation.difference import MEASURABLE, floor_of, length
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.refine.reprojection_cost import ReprojectionCost
from hodge_pipeline.report.document import Picture
from hodge_pipeline.types import Floats, Ints, ViewGraph
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.positions import PositionFit

NOTHING_TO_DO_M = 0.005
"""Change of poses in a room that may be ignored: a quarter of the voxel of clouds."""
TRUTH = "truth"
"""The name of the true poses."""
GRAPH_NAMES = {"distance": "near-centroid pairs", "iou": "overlapping pairs"}
"""What the pairs are called that poses are scored on."""


@dataclass(frozen=True)
class SourceSummary:
    """What was read: how many frames, how many of them with a true pose, and what the reader remarked.

    `key_frames` is None where every frame is a vertex of the graph. `format` is the reader's name, `kind`
    says what a frame is, `unordered` that all were joined from nothing; `is_scanner`: x is ahead and z up, where a
    camera has z ahead and y down.
    """

    name: str
    path: str
    frames: int
    frames_with_truth: int = 0
    sequences: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    key_frames: int | None = None
    format: str = ""
    kind: Literal["frames", "scans", "images", "poses"] = "frames"
    unordered: bool = False
    is_scanner: bool = False

    @property
    def counted(self) -> str:
        """`600 frames`, or `600 frames, 54 of them key frames`."""
        keys = "" if self.key_frames is None else f", {self.key_frames} of them key frames"
        return f"{self.frames} {self.kind}{keys}"

    @property
    def vertex_name(self) -> str:
        """What the vertices of the viewing graph are."""
        return self.kind if self.key_frames is None else "key frames"

    @property
    def vertex(self) -> str:
        """What one of them is."""
        return self.vertex_name.removesuffix("s")


@dataclass(frozen=True)
class TrajectoryRow:
    """Absolute (ATE) and relative (RPE, over `rpe_delta_frames`) error of one set of poses against the truth.

    `of` says what is counted in `frames` and `left_out`: the frames of the source, or the poses of a file; `worst` is
    the name of the frame with the largest error, where frames have names.
    """

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
    of: str = "frames"
    worst: str = ""


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
    why: str = ""


@dataclass(frozen=True)
class ComponentRow:
    """The frames of one connected part of the viewing graph, in words (`0–120, 124`)."""

    count: int
    frames: str


@dataclass(frozen=True)
class WrongEdges:
    """The edges judged wrong that the solver used: how many, at which frames most, and their effect: a solve without
    them moves poses by up to `moved_m`, aligned, and leaves `pieces_more` components more.
    """

    count: int
    frames: str = ""
    moved_m: float = 0.0
    pieces_more: int = 0

    def matters(self, scale: float) -> bool:
        """Whether anything changes without them: by more than `NOTHING_TO_DO_M` times the recipe's scale."""
        return self.pieces_more > 0 or self.moved_m > NOTHING_TO_DO_M * scale


@dataclass(frozen=True)
class GraphSummary:
    """The viewing graph in numbers: what it joins, where its edges come from, what was rejected and why, and how many
    edges the diagnosis judged how.
    """

    vertices: int
    edges: int
    edges_by_source: Mapping[str, int]
    components: tuple[ComponentRow, ...]
    edges_ignored: int
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
class RefinementSummary:
    """What became of a refinement: `outcome` is refined, optimal, worse, forced, convention or nothing; why; what it
    rests on; and why even what is kept may be wrong, if anything says so. Of a model: what each candidate costs, and
    which row is `kept`.
    """

    outcome: str
    headline: str
    reason: str
    measures: tuple[Measure, ...] = ()
    change: str = ""
    scale: str = ""
    candidates: tuple[tuple[str, ReprojectionCost], ...] = ()
    kept: int = 0
    doubt: str = ""


@dataclass(frozen=True)
class Path3D:
    """The positions (N, 3) and rotations (N, 3, 3) of one set of poses, aligned to be compared; NaN where a frame has
    none; no rotations in a report of an earlier version.
    """

    name: str
    positions: Floats
    rotations: Floats | None = None


@dataclass(frozen=True)
class Residuals:
    """Residuals (E,) of all edges at one set of poses, in metres and radians."""

    name: str
    translation_m: Floats
    angle_rad: Floats


@dataclass(frozen=True)
class Pictures:
    """What the plots are drawn from; a plot without its data is left out.

    `component (N,)` breaks the paths between parts and sequences; `names (N,)` and `stamps_s (N,)` are those of their
    frames. `convergence` holds the objective after each iteration, one series for each solve. `changed_most` shows the
    place that changed most before and after, `sides` the whole scene, `worst_pairs` the frames of the worst edges.
    """

    paths: tuple[Path3D, ...] = ()
    component: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    residuals: tuple[Residuals, ...] = ()
    graph: ViewGraph | None = None
    convergence: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    stamps_s: Floats = field(default_factory=lambda: np.zeros(0))
    changed_most: tuple[Picture, ...] = ()
    sides: tuple[Picture, ...] = ()
    worst_pairs: tuple[Picture, ...] = ()

    @classmethod
    def of_graph(cls, sets: Mapping[str, Floats], graph: ViewGraph, component: Ints) -> Pictures:
        """The paths of these sets of poses, and the residuals of a graph's edges at them."""
        residuals = tuple(Residuals(name, *edge_residuals(graph, poses)) for name, poses in sets.items())
        return cls(paths_of(sets), component, residuals, graph)


def paths_of(sets: Mapping[str, Floats]) -> tuple[Path3D, ...]:
    """The paths of sets of poses (N, 4, 4)."""
    return tuple(Path3D(name, poses[:, :3, 3], poses[:, :3, :3]) for name, poses in sets.items())


@dataclass(frozen=True)
class Report:
    """Everything that `report.html` and `report.json` say about one run.

    `before` and `after` name the sets of poses that the verdict compares, as in `scores` and `trajectories`.
    `energies` are those of the parts of ω before the solve of each round.
    `last_shift_m` is how far the last round moved the positions (root mean square), None where it had none before it.
    `wrong_edges` is None where nobody judged; `unmeasured` says why no measure was taken; without `has_metres` lengths
    are in the source's own unit. `position_fit` is None without known positions. `shows_rejected`: the pictures and
    scores are of a refinement that is not kept.
    """

    title: str
    source: SourceSummary
    before: str = "odometry"
    after: str = "result"
    refinement: RefinementSummary | None = None
    scores: ScoreTable | None = None
    trajectories: tuple[TrajectoryRow, ...] = ()
    loops: tuple[LoopRow, ...] = ()
    energies: Mapping[str, Energies] = field(default_factory=dict)
    graph: GraphSummary | None = None
    worst_edges: tuple[EdgeRow, ...] = ()
    stages: tuple[StageRow, ...] = ()
    notes: tuple[Note, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    recipe: str = ""
    last_shift_m: float | None = None
    wrong_edges: WrongEdges | None = None
    unmeasured: str = ""
    position_fit: PositionFit | None = None
    has_metres: bool = True
    shows_rejected: bool = False
    pictures: Pictures = field(default_factory=Pictures)

    @property
    def scale(self) -> float:
        """The unit that recipes are written in, in metres: 1 in a room."""
        return self.scores.scale if self.scores else 1.0

    @property
    def total(self) -> StageRow | None:
        """The times of all stages added up, and the most memory that one took; None where no stage was measured."""
        if not self.stages:
            return None
        wall_s, cpu_s = (sum(getattr(stage, name) for stage in self.stages) for name in ("wall_s", "cpu_s"))
        return StageRow("all", wall_s, cpu_s, max(stage.peak_mb for stage in self.stages))

    @property
    def floor_m(self) -> float:
        """The least difference of lengths that the report takes for one: see `MEASURABLE`.

        The extent is that of the positions, or the unit that recipes are written in (1 m in a room) where that is
        larger.
        """
        scale = self.scores.scale if self.scores else 0.0
        return max(floor_of(*(path.positions for path in self.pictures.paths)), MEASURABLE * scale)

    @property
    def pieces(self) -> tuple[int, ...]:
        """The frames of each piece that joins at least two, most first."""
        parts = () if self.graph is None else self.graph.components
        return tuple(sorted((part.count for part in parts if part.count > 1), reverse=True))

    @property
    def verdicts_of_concern(self) -> int:
        """Edges that the solver used, and that the diagnosis judged wrong or suspect."""
        used = {} if self.graph is None else self.graph.verdicts_in_use
        return used.get("wrong", 0) + used.get("suspect", 0)

    def length(self, value: float, *others: float) -> str:
        """A length in a unit that suits its size; without a unit where none is known."""
        return length(value, *others) if self.has_metres else f"{value:.3g}"
