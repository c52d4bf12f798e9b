"""What lies beside a COLMAP model: depth images, the database of its edges, and known positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hodge_adapters.colmap.database import Known


@dataclass(frozen=True)
class DepthOptions:
    """Depth beside the images: the file of each image by its name, and how to read it."""

    files: dict[str, Path]
    units_per_metre: float
    no_depth: tuple[int, ...]
    camera: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class EdgeOptions:
    """Where the relative poses come from, and how many points they need."""

    database: Path | None
    min_shared: int
    max_edges_per_image: int
    seed: int


@dataclass(frozen=True)
class PriorOptions:
    """What is known of images by name beside their pixels, the file it comes from, and sigma where none is stated."""

    images: Mapping[str, Known] = field(default_factory=dict)
    file: Path | None = None
    sigma_m: float = 1.0
