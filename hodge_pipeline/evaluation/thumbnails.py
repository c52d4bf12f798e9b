"""Small pictures of frames: their colour image, or their depth where they have none."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from PIL import Image

from hodge_pipeline.types import Bytes, Frame

WIDTH = 300
GAP = 6


def pair_of(first: Frame, second: Frame) -> Bytes | None:
    """Two frames side by side at one height; None where either has nothing to show. Raises what their readers raise."""
    images = [thumbnail(frame) for frame in (first, second)]
    shown = [image for image in images if image is not None]
    if len(shown) < 2:
        return None
    height = min(len(image) for image in shown)
    gap = np.full((height, GAP, 3), 255, np.uint8)
    return np.hstack([shown[0][:height], gap, shown[1][:height]])


def thumbnail(frame: Frame) -> Bytes | None:
    """One frame, `WIDTH` pixels wide."""
    if frame.read_colour is not None:
        image = frame.read_colour()
    elif frame.read_depth is not None:
        depth = frame.read_depth()
        far = max(float(np.percentile(depth, 98)), 1e-3)
        image = (colormaps["cividis"](np.clip(depth / far, 0, 1))[:, :, :3] * 255).astype(np.uint8)
    else:
        return None
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((WIDTH, height)))
