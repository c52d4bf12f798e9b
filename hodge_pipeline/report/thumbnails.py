"""Small pictures of frames: their colour image, or their depth where they have none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from PIL import Image

from hodge_pipeline.types import Bytes, Frame

WIDTH = 300
GAP = 6
PAPER = 255


def pair_of(first: Frame, second: Frame) -> Bytes | None:
    """Two frames side by side; None where either has nothing to show. Raises what their readers raise."""
    images = [thumbnail(frame) for frame in (first, second)]
    shown = [image for image in images if image is not None]
    return beside(shown) if len(shown) == len(images) else None


def thumbnail(frame: Frame, width: int = WIDTH) -> Bytes | None:
    """One frame, so many pixels wide; None where it has nothing to show."""
    if frame.read_colour is not None:
        image = frame.read_colour()
    elif frame.read_depth is not None:
        depth = frame.read_depth()
        far = max(float(np.percentile(depth, 98)), 1e-3)
        image = (colormaps["cividis"](np.clip(depth / far, 0, 1))[:, :, :3] * 255).astype(np.uint8)
    else:
        return None
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((width, height)))


def beside(images: Sequence[Bytes]) -> Bytes:
    """Pictures beside each other, white between them and below lower ones."""
    widths = [image.shape[1] for image in images]
    height = max(len(image) for image in images)
    canvas = np.full((height, sum(widths) + GAP * (len(images) - 1), 3), PAPER, np.uint8)
    for image, left in zip(images, np.cumsum([0, *(width + GAP for width in widths[:-1])]).tolist(), strict=True):
        canvas[: len(image), left : left + image.shape[1]] = image
    return canvas
