"""Whether depth is in metres: by its range, and by the steps in which structured light and stereo store it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types import Floats
from hodge_pipeline.types.notes import Note

SAMPLED_FRAMES = 8
PLAUSIBLE_DEPTH_M = (0.25, 30.0)
"""Range of the median depth of a scene: outside, the scale is probably wrong. Few depth cameras see nearer (L515
0.25 m, D435 0.28, Kinect 0.4)."""
NEAR_M, FAR_M = 1.3, 10.0
"""Metres. Doubted is 99 % of depth below the first, where a room of 6.5 m ends in millimetres read at TUM's 5000 per
metre, and a quarter beyond the second: depth cameras for rooms reach 10 m (RealSense D435; Kinect and Xtion 4 to 8)."""
PRIMESENSE_STEP = 2.89e-3
"""Step of 1/z, in 1/m: an eighth of a pixel over 580 px times 7.5 cm. Seven Kinect sequences show 2.88 to 2.92e-3, two
recordings of a RealSense 1.63 and 1.01e-3."""
WRONG_UNITS, SAME, ALIKE = (0.2, 5.0, 8.0, 10.0), 0.03, 1.45
"""Factors on depth of known wrong units: millimetres read as TUM's, the reverse, OpenNI's shifted by three bits, tenths
of a millimetre. Steps of one kind of sensor differ by less than `SAME`; a step off by more than a factor `ALIKE` is
that of another sensor."""
NEAR_STEP, NEAR_WIDTH_PX = 5.2e-3, 640
"""Step of 1/z, in 1/m, in images of this width: of the RealSense D405, 1/32 of a pixel over 340 px times 18 mm.
Cameras of coarser steps (longer ranges, or fewer parts of a pixel) see nothing nearer than `PLAUSIBLE_DEPTH_M`."""
SEEN_M = 4.0
"""Metres: a Kinect hardly sees a larger median depth, so that finer steps then rather mean a wrong unit."""
FEWEST_PIXELS, FEWEST_VALUES, ROUNDINGS = 5, 20, 5
"""Pixels that a value needs to count; steps needed; their least length in units of the stored number."""
WHOLE, MOSTLY = 0.15, 0.9
"""Distance of a step from a whole multiple of the base step, at most, and the share of steps that must keep it."""


def doubts_of(depth_m: NDArray[np.floating[Any]], width_px: int = NEAR_WIDTH_PX) -> tuple[Note, ...]:
    """Notes on depths of many pixels of images so wide, 0 where there is none, that seem not to be in metres."""
    valid = depth_m[depth_m > 0]
    if not len(valid):
        return ()
    median, far, most = (float(value) for value in np.quantile(valid, (0.5, 0.75, 0.99)))
    step = inverse_step(valid)
    by_steps = None if step is None else _by_steps(step, median)
    if by_steps is not None:
        return (by_steps,)
    if step is not None and _is_too_near(step, median, width_px):
        return (Note("depth unit", detail=_too_near(step, median)),)
    if not PLAUSIBLE_DEPTH_M[0] < median < PLAUSIBLE_DEPTH_M[1]:
        return (Note("depth range", detail=f"the median depth is {median:.3g} m"),)
    if most < NEAR_M:
        return (Note("depth range", detail=f"all depth lies within {most:.2g} m, as in a close-up"),)
    if far > FAR_M:
        return (Note("depth range", detail=f"a quarter of depth lies beyond {far:.3g} m, as out of doors"),)
    return ()


def are_millimetres_as_tums(depth_m: NDArray[np.floating[Any]], width_px: int = NEAR_WIDTH_PX) -> bool:
    """Whether depths, read at TUM's 5000 a metre, are rather stored in millimetres, as `doubts_of` says."""
    valid = depth_m[depth_m > 0]
    step = inverse_step(valid) if len(valid) else None
    if step is None:
        return False
    median = float(np.median(valid))
    return _by_steps(step, median) is None and _is_too_near(step, median, width_px)


def inverse_step(depth_m: NDArray[np.floating[Any]]) -> float | None:
    """The step of 1/z, in 1/m, of which depths are whole multiples, as structured light and stereo measure them; None
    where they are not: time of flight, phones, renderings.
    """
    values, counts = np.unique(depth_m, return_counts=True)
    z: Floats = values[counts >= FEWEST_PIXELS].astype(float)
    gaps = np.diff(z)
    if len(gaps) < FEWEST_VALUES:
        return None
    # Near the camera steps are shorter than the unit of the file, and rounded to it.
    coarse = gaps >= 0.999 * ROUNDINGS * gaps.min()
    steps = (1 / z[:-1] - 1 / z[1:])[coarse]
    if len(steps) < FEWEST_VALUES:
        return None
    base = float(np.median(steps[steps <= 1.5 * np.quantile(steps, 0.2)]))
    multiples = steps / base
    return base if (np.abs(multiples - np.round(multiples)) < WHOLE).mean() > MOSTLY else None


def _is_too_near(step: float, median_m: float, width_px: int) -> bool:
    return median_m < PLAUSIBLE_DEPTH_M[0] and step > NEAR_STEP * NEAR_WIDTH_PX / width_px


def _too_near(step: float, median_m: float) -> str:
    return (
        f"no camera whose steps are {1000 * step:.2g} mm at 1 m sees as near as {median_m:.2g} m, the median; stored "
        f"in millimetres (source.reader.depth_scale=1000) and read at TUM's 5000, it would be {5 * median_m:.2g} m"
    )


def _by_steps(step: float, median_m: float) -> Note | None:
    """A note where depth would have PrimeSense's steps in another unit; other sensors have finer ones."""
    too_large = PRIMESENSE_STEP / step
    detail = (
        f"its steps, {1000 * step:.2g} mm at 1 m, are {1 / too_large:.3g} times those of PrimeSense's, which "
        f"source.reader.depth_scale {too_large:.3g} times as large would give"
    )
    if any(abs(too_large / unit - 1) < SAME for unit in WRONG_UNITS) and (too_large < 1 or median_m > SEEN_M):
        return Note("depth unit", detail=detail)
    return Note("depth steps", detail=detail) if SAME < abs(np.log(too_large)) < np.log(ALIKE) else None
