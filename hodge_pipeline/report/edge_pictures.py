"""Pictures of single edges: their two clouds by the edge and by the robust poses, and their images with matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from matplotlib.figure import Figure

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.registration.descriptors import CONFIDENCE, LOWE_RATIO, MOST_RANSAC_STEPS, match, root_sift
from hodge_pipeline.report import raster
from hodge_pipeline.report.diagnosis_page import EdgePictures
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.painting import painted
from hodge_pipeline.report.scene_pictures import images_of
from hodge_pipeline.types import Bytes, CloudSet, Floats, Floats32, Frame, Ints, PointCloud, ViewGraph
from hodge_pipeline.types.axes import SCANNER_AXES, is_scanner
from hodge_pipeline.types.text import UNKNOWN_UNIT

IMAGE_WIDTH = 420
LEAST_UP = 0.1
"""Length of the mean up direction (3,) below which there is none: cameras look every way."""
SIZE = 360, 270
STRAY_PERCENT = 1.0
BLUE, ORANGE = (0, 114, 178), (230, 120, 0)
CUT_SHARE, SEEN_SHARE = 0.04, 0.03
"""How thick a cut through clouds is, and how large an offset must be to be seen in it: of the clouds' extent."""
EXAGGERATIONS = (2, 5, 10, 20, 50, 100)

MAX_FEATURES = 1000
MAX_ERROR_PX = 2.0
"""Distance of an inlier from its epipolar line, at most."""
FEWEST = 8
"""Matches that a fundamental matrix needs."""
ODD_COLOUR, AGREEING_COLOUR = (160, 160, 160), (0, 158, 115)


def edge_pictures(
    graph: ViewGraph,
    diagnosis: Diagnosis,
    rows: Ints,
    frames: Sequence[Frame],
    clouds: CloudSet | None,
    *,
    has_metres: bool = True,
) -> tuple[EdgePictures, ...]:
    """The pictures of these edges; nothing for a graph without frames or clouds. `has_metres`: as of a `Report`."""
    scans, found = clouds is not None and is_scanner(clouds), []
    for row in map(int, rows):
        plots = tuple(_plots(graph, diagnosis, row, frames, clouds, has_metres=has_metres, scans=scans))
        if plots:
            found.append(EdgePictures(row, plots))
    return tuple(found)


def _plots(
    graph: ViewGraph,
    diagnosis: Diagnosis,
    row: int,
    frames: Sequence[Frame],
    clouds: CloudSet | None,
    *,
    has_metres: bool,
    scans: bool,
) -> Iterator[Picture]:
    i, j = graph.edges[row].tolist()
    names = graph.vertex_ids[i], graph.vertex_ids[j]
    if clouds is not None and len(clouds[i]) and len(clouds[j]):
        measured, known = graph.i_from_j[row], [("As the edge says", graph.i_from_j[row])]
        axes = SCANNER_AXES if scans else np.eye(3)
        up = _up(diagnosis, i, axes[1])
        if diagnosis.piece[i] == diagnosis.piece[j]:
            robust = se3.inverse(diagnosis.world_from_cam[i]) @ diagnosis.world_from_cam[j]
            known.append(("As the robust poses say", robust))
            yield _cut(clouds[i], clouds[j], measured, robust, up, names[1], has_metres=has_metres)
        views = _views(clouds[i], clouds[j], [motion for _, motion in known], up, axes)
        left = f"along x of {names[0]}" if scans else f"as camera {names[0]} looks"
        shown = f"Frame {names[0]} blue, frame {names[1]} orange; left {left}, right from above."
        for title, motion in known:
            both = raster.two(clouds[i], clouds[j], motion, (BLUE, ORANGE))
            yield Picture(title, shown, raster.jpeg(raster.beside([raster.picture(both, view) for view in views])))
    if frames:
        yield from _images(frames[i], frames[j])


def _up(diagnosis: Diagnosis, i: int, down: Floats) -> Floats:
    """The mean up direction (3,) of the component, in frame i's axes; `down (3,)` is down in the axes of each frame."""
    turns = diagnosis.world_from_cam[:, :3, :3]
    up = -(turns[diagnosis.piece == diagnosis.piece[i]] @ down).mean(axis=0)
    size = float(np.linalg.norm(up))
    return np.asarray(turns[i].T @ (up / size) if size > LEAST_UP else -down)


def _views(
    first: PointCloud, second: PointCloud, motions: Sequence[Floats], up_in_i: Floats, axes: Floats
) -> tuple[raster.View, raster.View]:
    """Along `axes` (3, 3), and from above: the same for every motion, so that the pictures compare."""
    moved = [se3.transform(motion, np.asarray(second.points_in_cam, float)) for motion in motions]
    points = np.concatenate([np.asarray(first.points_in_cam, float), *moved])
    across = np.cross(-up_in_i, axes[2])
    across /= max(float(np.linalg.norm(across)), 1e-9)
    above = np.stack([across, np.cross(-up_in_i, across), -up_in_i])
    ahead, down = (raster.holding(axes, points, SIZE, STRAY_PERCENT) for axes in (axes, above))
    return replace(ahead, culled=False), replace(down, culled=False)


def _cut(
    first: PointCloud,
    second: PointCloud,
    measured: Floats,
    robust: Floats,
    up_in_i: Floats,
    name: object,
    *,
    has_metres: bool,
) -> Picture:
    """Both clouds cut open along the offset between the edge and the robust poses, which is exaggerated if small."""
    blue, points = np.asarray(first.points_in_cam, float), np.asarray(second.points_in_cam, float)
    middle = points.mean(axis=0)
    offset = se3.transform(measured, middle[None])[0] - se3.transform(robust, middle[None])[0]
    size = float(np.linalg.norm(offset))
    extent = float(np.linalg.norm(np.percentile(blue, 95, axis=0) - np.percentile(blue, 5, axis=0)))
    times = _exaggeration(size, extent)
    shown = robust @ se3.exp(times * se3.log(se3.inverse(robust) @ measured))
    along = offset / size if size > 0 else np.eye(3)[0]
    normal = up_in_i - (up_in_i @ along) * along
    normal = normal / np.linalg.norm(normal) if np.linalg.norm(normal) > LEAST_UP else np.cross(along, np.eye(3)[0])
    plane = np.stack([np.cross(normal, along), along])
    orange = [se3.transform(motion, points) for motion in (shown, robust)]
    height = float(np.median(orange[1] @ normal))

    def paint(figure: Figure) -> None:
        for axes, title, moved in zip(figure.subplots(1, 2), ("edge", "robust poses"), orange, strict=True):
            for cloud, colour, marker in ((blue, BLUE, "o"), (moved, ORANGE, "^")):
                x, y = plane @ cloud[np.abs(cloud @ normal - height) < CUT_SHARE * extent / 2].T
                axes.scatter(x, y, s=2, color=np.array(colour) / 255, marker=marker, linewidths=0)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("m" if has_metres else UNKNOWN_UNIT, fontsize=8)
            axes.tick_params(labelsize=7)

    told = f", here {times} times as large" if times > 1 else ""
    said = length if has_metres else "{:.3g} units".format
    caption = (
        f"A slice through both clouds, {said(CUT_SHARE * extent)} thick, along the offset: frame {name} (orange) "
        f"lies {said(size)} apart{told}."
    )
    return painted("Cut open", caption, paint)


def _exaggeration(size: float, extent: float) -> int:
    """How many times an offset is enlarged, so that it is seen: 1 where it is anyway, or is nothing."""
    if size <= 0 or size >= SEEN_SHARE * extent:
        return 1
    return next((times for times in EXAGGERATIONS if times * size >= SEEN_SHARE * extent), EXAGGERATIONS[-1])


def _images(first: Frame, second: Frame) -> Iterator[Picture]:
    """The frames as their cameras saw them; a frame with nothing to show, or nothing that can be read, has none."""
    shown = images_of((first, second), IMAGE_WIDTH)
    if len(shown) < 2:
        return
    title = f"Images of {first.frame_id} and {second.frame_id}"
    if first.read_colour is None or second.read_colour is None:
        caption = "Depth where there is no colour: the brighter, the farther."
        yield Picture(title, caption, raster.jpeg(raster.beside(shown)))
        return
    found = draw_matches(*shown)
    caption = (
        f"{found.matches} SIFT matches; {found.agreeing} of them (green) agree on one relative pose. Places that look "
        "alike match too: see whether the whole views fit."
    )
    yield Picture(title, caption, raster.jpeg(found.image))


@dataclass(frozen=True)
class MatchedImages:
    """The picture (H, W, 3), the number of matches, and how many of them are inliers of one relative pose."""

    image: Bytes
    matches: int
    agreeing: int


def draw_matches(first: Bytes, second: Bytes) -> MatchedImages:
    """Two RGB images with a line for each match: green where one relative pose explains it, else grey."""
    canvas = raster.beside([first, second])
    found = [_features(image) for image in (first, second)]
    pairs = match(found[0][1], found[1][1], LOWE_RATIO)
    agreeing = _agreeing(found[0][0], found[1][0], pairs)
    offset = np.array([first.shape[1] + raster.GAP, 0], np.float32)
    for colour, rows in ((ODD_COLOUR, ~agreeing), (AGREEING_COLOUR, agreeing)):
        for a, b in pairs[rows]:
            start, end = np.round([found[0][0][a], found[1][0][b] + offset]).astype(int).tolist()
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
    return MatchedImages(canvas, len(pairs), int(agreeing.sum()))


def _features(image: Bytes) -> tuple[Floats32, Floats32]:
    """Pixels (n, 2) and unit descriptors (n, 128)."""
    detector = cv2.SIFT_create(nfeatures=MAX_FEATURES)  # type: ignore[attr-defined]
    points, descriptors = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not points:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), root_sift(descriptors.astype(np.uint8))


def _agreeing(first: Floats32, second: Floats32, pairs: Ints) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where (M,) a match is explained by the fundamental matrix that explains most: the same answer every time."""
    if len(pairs) < FEWEST:
        return np.zeros(len(pairs), bool)
    cv2.setRNGSeed(0)
    model, inlier = cv2.findFundamentalMat(
        first[pairs[:, 0]], second[pairs[:, 1]], cv2.FM_RANSAC, MAX_ERROR_PX, CONFIDENCE, MOST_RANSAC_STEPS
    )
    if model is None or inlier is None or inlier.sum() < FEWEST:
        return np.zeros(len(pairs), bool)
    return np.asarray(inlier.ravel() > 0)
