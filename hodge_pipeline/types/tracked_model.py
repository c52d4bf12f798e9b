"""A model of structure from motion: posed images and the points that they track, as its reader gives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from hodge_pipeline.types import Bools, CloudSet, Floats, Frame, Ints, ModelQuality, PositionPriors, ViewGraph

Adjusted: TypeAlias = Literal["nothing", "points", "all"]
"""What an adjustment moves: nothing, points alone, or points and bodies."""
GAUGE = 7
"""Turn, shift and size of the whole, which no track tells."""


@dataclass(frozen=True)
class PoseInformation:
    """Information (G, n, n) over (φ, ρ) of the `fixed (B,)` bodies, one after the other: of all of them as one group,
    or, where they are too many, of each given all others, which is too sure.
    """

    fixed: Bools
    groups: Floats

    @cached_property
    def standard_errors(self) -> Floats:
        """Of each body's rotation (rad) and position (units) (B, 2): roots of the mean variance of three axes.

        In the gauge in which the bodies as a whole stay where they are. NaN of bodies that are not fixed.
        """
        out = np.full((len(self.fixed), 2), np.nan)
        if self.fixed.any():
            alone = len(self.groups) == self.fixed.sum() > 1
            covariance = np.linalg.pinv(self.groups, hermitian=True) if alone else self._without_gauge()[None]
            variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
            out[self.fixed] = np.sqrt(np.maximum(variances, 0.0))
        return out

    def _without_gauge(self) -> Floats:
        """The pseudo-inverse without the directions that are free; lengths count as angles, which suits unit scenes."""
        values, vectors = np.linalg.eigh((self.groups[0] + self.groups[0].T) / 2)
        kept = np.arange(len(values)) >= GAUGE
        kept &= values > 1e-12 * values[-1]
        return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


class TrackedModel(Protocol):
    """Posed images with the points they track, as structure from motion leaves them; its unit of length is its own.

    What moves is a body: a rig with its cameras held rigid, or a single image. Every method gives a new model and
    leaves this one as it is; images, cameras, tracks and names stay what they are unless it says otherwise.
    """

    @property
    def name(self) -> str:
        """What a person calls it: the folder it came from."""

    @property
    def native(self) -> Any:
        """The model as its own library holds it."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that it was read from, to be given back; none where it has been joined or made in memory."""

    @property
    def measurements(self) -> tuple[Path, ...]:
        """The files beside the model that its edges come from: matches, depth."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was skipped or repaired so far, one line each."""

    @property
    def frames(self) -> Sequence[Frame]:
        """The posed images (N), in order, with what can be read of them; positions in the model's unit."""

    @property
    def body_names(self) -> tuple[str, ...]:
        """The bodies (B), as the model names them."""

    @property
    def world_from_body(self) -> Floats:
        """Their poses (B, 4, 4)."""

    @property
    def body_of_frame(self) -> Ints:
        """The body (N,) that carries each image."""

    @property
    def body_from_cam(self) -> Floats:
        """Where (N, 4, 4) the body carries it."""

    @property
    def quality(self) -> ModelQuality:
        """How well points and images agree."""

    def seen_depths(self) -> Sequence[Floats]:
        """For each image with depth, in a few hundred of them, at the tracked points (K, 3): metres that the sensor
        saw, units that the model has, and the length of the ray to unit depth.
        """

    def seen_points(self) -> CloudSet:
        """For each body the points that its images track, in its axes and the model's unit, with their colours."""

    def thinned(self, most_seen: int) -> TrackedModel:
        """The model with a random part of its tracks, of which each image sees so many, or all of its own; this very
        model where no image sees more.
        """

    def measured(self) -> tuple[ViewGraph, tuple[str, ...]]:
        """Relative poses of the bodies, estimated anew from what their images share, and what was left out."""

    def scaled(self, factor: float, motion: Floats | None = None) -> TrackedModel:
        """The model in another unit of length, then moved as a whole by `motion` (4, 4)."""

    def scaled_parts(self, part: Ints, factors: Floats, motions: Floats) -> TrackedModel:
        """The positions of each part (B,) of the bodies, with the points they see, times its own factor (G,), then
        moved (G, 4, 4); a point of several parts is where their rays then meet. Rigs keep their baselines: factors are
        1 where there are any.
        """

    def placed(self) -> TrackedModel:
        """The model in the world of positions that are known of its images; as it is where none are."""

    @property
    def placing(self) -> str:
        """What gave the model its place in the world, empty where nothing did."""

    @property
    def known_positions(self) -> PositionPriors | None:
        """Where bodies should be, of a model that was placed by known positions, metres."""

    @property
    def held_apart(self) -> int:
        """How many pairs of images are well matched while they hardly share a point."""

    def resected(self, bodies: Bools | None = None) -> Floats:
        """Poses (B, 4, 4): of the chosen bodies (B,), all by default, those that the points as they are give them."""

    def moved(self, world_from_body: Floats) -> TrackedModel:
        """The bodies at these poses (B, 4, 4), each point where that fits its observations best."""

    def merged(self) -> TrackedModel:
        """Points that a match calls one merged where one position fits; this very model where there are none."""

    def adjusted(
        self, priors: PositionPriors | None = None, *, move_bodies: bool = True, near_optimum: bool = False
    ) -> TrackedModel:
        """Bundle adjustment of poses and points, or of points alone; with larger steps where it starts near an optimum.

        Raises `SourceError` where it fails.
        """

    @property
    def has_converged(self) -> bool:
        """False of an adjusted model whose adjustment ended by its limit of steps."""

    def with_robust_loss(self) -> TrackedModel:
        """The same model, whose adjustments let an observation that is far off pull little."""
        ...

    def with_free(self, refine: Literal["rig", "focal", "all"]) -> TrackedModel:
        """The same model, whose adjustments refine rigs, focal lengths or all intrinsics, as far as tells a gain."""
        ...

    @property
    def moves_calibration(self) -> bool:
        """Whether that adjusts the cameras' intrinsics, or their places in rigs, too."""

    @property
    def information(self) -> PoseInformation:
        """What the tracks tell of the bodies' poses."""

    def held_out_errors(self, entries: Bools, adjusts: Adjusted) -> Floats:
        """Errors (H,) in pixels of the observations chosen from the N of `quality`, after an adjustment without them of
        nothing, of the points, or of bodies too; those that their points cannot spare are left out.
        """

    def write(self, folder: Path) -> None:
        """Write it in its own format into a folder that exists."""

    def read_back(self, folder: Path, notes: tuple[str, ...]) -> TrackedModel:
        """What a model made from this one has written to a folder, with its notes."""
