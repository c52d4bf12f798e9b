"""What an adjustment of a COLMAP model made of its calibration, in words."""

from __future__ import annotations

import numpy as np

from hodge_adapters.colmap.bundle import Refine
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_pipeline.types import Floats


def calibration_changes(
    before: pycolmap.Reconstruction, after: pycolmap.Reconstruction, refine: Refine
) -> tuple[str, ...]:
    """Lines on how the adjustment to another model changed rigs, focal lengths and principal points."""
    if refine == "none":
        return ()
    if refine == "rig":
        return _rig_changes(before, after)
    cameras = before.cameras
    pairs = [(cameras[key].mean_focal_length(), new.mean_focal_length()) for key, new in after.cameras.items()]
    ratios: Floats = np.array([new / old for old, new in pairs])
    low, middle, high = 100 * (np.percentile(ratios, [0, 50, 100]) - 1)
    told = [f"focal lengths of {len(ratios)} cameras changed by {middle:+.3g} % ({low:+.3g} to {high:+.3g} %)"]
    if len(ratios) == 1:
        told = [f"focal length {pairs[0][0]:.6g} → {pairs[0][1]:.6g} px"]
    if refine == "all":
        shift = [
            np.hypot(new.principal_point_x - old.principal_point_x, new.principal_point_y - old.principal_point_y)
            for old, new in ((cameras[key], new) for key, new in after.cameras.items())
        ]
        told += [f"principal points moved by {np.median(shift):.3g} px"]
    return tuple(told)


def _rig_changes(before: pycolmap.Reconstruction, after: pycolmap.Reconstruction) -> tuple[str, ...]:
    """A line on how far cameras turned in their rigs, and moved as a share of their distance from its origin."""
    turns, shifts, distances = list[float](), list[float](), list[float]()
    for rig_id, rig in before.rigs.items():
        for sensor, old in rig.non_ref_sensors.items():
            if old is not None:
                moved = after.rigs[rig_id].non_ref_sensors[sensor] * old.inverse()
                turns.append(float(np.degrees(moved.rotation.angle())))
                shifts.append(float(np.linalg.norm(moved.translation)))
                distances.append(float(np.linalg.norm(old.translation)))
    if not turns:
        return ()
    told = f"cameras turned in their rigs by up to {max(turns):.2g}°"
    return (f"{told} and moved by up to {max(shifts) / max([*distances, 1e-300]):.0%} of the rig",)
