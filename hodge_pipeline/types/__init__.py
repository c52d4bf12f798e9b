"""The data that flows between stages. Poses are `world_from_cam`, float64; metres, radians, seconds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types.arrays import Bools as Bools
from hodge_pipeline.types.arrays import Bytes as Bytes
from hodge_pipeline.types.arrays import Floats as Floats
from hodge_pipeline.types.arrays import Floats32 as Floats32
from hodge_pipeline.types.arrays import Ints as Ints
from hodge_pipeline.types.arrays import Words as Words
from hodge_pipeline.types.camera import Camera as Camera
from hodge_pipeline.types.clouds import CloudSet as CloudSet
from hodge_pipeline.types.clouds import Landmarks as Landmarks
from hodge_pipeline.types.clouds import PointCloud as PointCloud
from hodge_pipeline.types.edges import Edges as Edges
from hodge_pipeline.types.edges import Priors as Priors
from hodge_pipeline.types.edges import Registration as Registration
from hodge_pipeline.types.edges import ViewGraph as ViewGraph
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.positions import Positions as Positions
from hodge_pipeline.types.text import counted

LEAST_WEIGHT = 1e-3
"""Weight of an edge, relative to its own information, above which it counts."""


@dataclass(frozen=True)
class ImageFile:
    """The file of the colour image that a frame is made from, with the distortion of its lens.

    `lens` is a camera model by COLMAP's name (PINHOLE, OPENCV, …), `params` are its parameters in COLMAP's order, in
    pixels; (0, 0) is the outer corner of the image.
    """

    path: Path
    width: int
    height: int
    lens: str
    params: tuple[float, ...]


@dataclass(frozen=True)
class EncodedImage:
    """An image as its file holds it, to be passed through undecoded; `units_per_metre` of depth images alone."""

    contents: bytes
    media_type: str
    units_per_metre: float | None = None


@dataclass(frozen=True)
class Frame:
    """One view, lazily read and re-readable.

    The `read_*` callables decode a file each time they are called and pickle by reference (partials of module-level
    functions), so a worker process can read what it needs. A source without images gives `read_points` alone.

    - `read_depth()` gives (H, W) float32 metres, 0 where there is no measurement.
    - `read_colour()` gives (H, W, 3) uint8 RGB.
    - `stamp_s` is the moment of the depth image; the colour image was taken `colour_delay_s` later.
    - `image` is the file of the colour image, of another camera model where the frame is undistorted; None without one.
    - `world_from_cam` is the pose that the source gives; None where it has none. The result is compared with it; the
      pipeline never starts from it unless a recipe says so.
    - `true_world_from_cam` is the true pose: of a benchmark, or of what the user names as the truth; else None.
    """

    frame_id: int | str
    stamp_s: float
    camera: Camera | None = None
    read_depth: Callable[[], Floats32] | None = None
    read_colour: Callable[[], Bytes] | None = None
    read_points: Callable[[], PointCloud] | None = None
    encoded_depth: Callable[[], EncodedImage] | None = None
    encoded_colour: Callable[[], EncodedImage] | None = None
    image: ImageFile | None = None
    world_from_cam: Floats | None = None
    true_world_from_cam: Floats | None = None
    sequence: str = ""
    colour_delay_s: float = 0.0


def number_of(frame: Frame) -> int | str:
    """The number of a frame: its id; of a frame with a name its stamp where that is a whole number, else the name."""
    named = isinstance(frame.frame_id, str)
    return int(frame.stamp_s) if named and float(frame.stamp_s).is_integer() else frame.frame_id


@dataclass(frozen=True)
class Trajectory:
    """Poses in time: `stamps_s (N,)` seconds, ascending; `world_from_cam (N, 4, 4)`.

    `has_stamps`: False where its format has neither stamps nor frame numbers; `stamps_s` then number the poses.
    """

    stamps_s: Floats
    world_from_cam: Floats
    has_stamps: bool = True

    @classmethod
    def of_frames(cls, frames: Sequence[Frame]) -> Trajectory | None:
        """The poses of the frames that have one, in their order; None where none has."""
        posed = [(frame.stamp_s, frame.world_from_cam) for frame in frames if frame.world_from_cam is not None]
        return cls(np.array([stamp for stamp, _ in posed]), np.array([pose for _, pose in posed])) if posed else None

    def __len__(self) -> int:
        return len(self.stamps_s)


@dataclass(frozen=True)
class Source:
    """What a reader's `open` gives: any of lazy frames, a trajectory, a measured graph.

    - `trajectory` is the whole trajectory that the frames' poses come from, on its own stamps, where there is one.
    - `notes` say what was skipped or repaired, with counts: one line each; `doubts` what may be wrong or missing.
    - `positions` of its frames that are known from elsewhere, such as satellite fixes; None where it has none.
    - `files` identify the input: a run is resumed only while their sizes and times are unchanged.
    - `contents` say what a recording holds, used or not, a line each: its topics, its transforms.
    - `of_cameras`: its format says that poses are cameras', z ahead and y down; else a graph's are robots', z up.
    - `in_metres`: False for a model of images alone, whose lengths are in a unit of its own.
    - `numbered_hz`: the frame rate where stamps are frame numbers; 0: unknown.
    """

    name: str
    path: Path
    frames: Sequence[Frame] = ()
    trajectory: Trajectory | None = None
    graph: ViewGraph | None = None
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    contents: tuple[str, ...] = ()
    positions: Positions | None = None
    of_cameras: bool = False
    doubts: tuple[Note, ...] = ()
    in_metres: bool = True
    numbered_hz: float = 0.0

    def __repr__(self) -> str:
        parts = [f"{len(self.frames)} frames"]
        parts += [] if self.trajectory is None else [f"a trajectory of {len(self.trajectory)} poses"]
        parts += [] if self.graph is None else [repr(self.graph)]
        parts += [] if self.positions is None else [f"{len(self.positions)} known positions"]
        return f"Source({self.name!r}: {', '.join(parts)})"


@dataclass(frozen=True)
class Match:
    """The motion `i_from_j (4, 4)` between two clouds, found without a guess: `inliers` of the `matches` agree with it.

    The identity with no inlier where nothing was found. `rivals`: how many other matches agree with one other motion; 0
    also where none was looked for. `others`: further motions, for the clouds to decide between.
    """

    i_from_j: Floats
    inliers: int
    matches: int
    rivals: int = 0
    others: tuple[Match, ...] = ()


@dataclass(frozen=True)
class SolverIteration:
    """One step of a solver: the poses after it, the objective at them, and what else it measured."""

    world_from_cam: Floats
    objective: float
    metrics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Solution:
    """Consistent poses, and how they were reached.

    - `component (V,)`: the connected component of each vertex, 0 the largest.
    - `weights (E,)`: the final weight of each edge relative to its own information, 0 for one that was ignored.
    - `converged`: whether a minimum was reached, None where the solver does not tell; `stopped_by`: what stopped it
      before; `certified`: whether the minimum is proven global, None where that was not tried.
    - `confirmed`: of a robust solve, whether cycles of the edges that it used close better than by chance; None where
      it left no edge out and has no cycle, as in a tree, and of other solves.
    """

    world_from_cam: Floats
    component: Ints
    weights: Floats
    history: tuple[SolverIteration, ...] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    converged: bool | None = None
    stopped_by: str = ""
    certified: bool | None = None
    confirmed: bool | None = None

    @property
    def kept(self) -> Bools:
        """Where (E,) an edge counts: robust solvers leave a small rest of weight to some that they leave out."""
        return np.asarray(self.weights > LEAST_WEIGHT)

    def __repr__(self) -> str:
        pieces = int(self.component.max(initial=-1)) + 1
        used = int(np.count_nonzero(self.weights))
        poses = f"{counted(len(self.component), 'pose')} in {counted(pieces, 'component')}"
        return f"Solution({poses}, {used} of {counted(len(self.weights), 'edge')} count)"


@dataclass(frozen=True)
class Model:
    """A fused scene in the world frame: points (N, 3), normals, 8-bit RGB, and triangles (T, 3) where it is a mesh."""

    name: str
    points_in_world: Floats32
    normals_in_world: Floats32 | None = None
    colours: Bytes | None = None
    triangles: NDArray[np.int32] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelQuality:
    """How well the points of a model fit its images, by N observations.

    - `keypoints (N, 2)`: the row in `image_names`, and the number of the image's keypoint.
    - `errors_px (N,)`: reprojection errors, infinite where the point lies behind the camera.
    - `parallaxes_deg (N,)`: the angle between the rays to the point; `track_lengths (N,)`: images that see it.
    - `point_rows (N,)`: the row of the point, below `points`.
    """

    images: int
    points: int
    mean_track_length: float
    image_names: tuple[str, ...]
    keypoints: Ints
    errors_px: Floats
    parallaxes_deg: Floats
    track_lengths: Ints
    point_rows: Ints


@dataclass(frozen=True)
class PositionPriors:
    """Priors on where the bodies of a model are: `positions (B, 3)`, `covariances (B, 3, 3)`, NaN without a prior."""

    positions: Floats
    covariances: Floats
