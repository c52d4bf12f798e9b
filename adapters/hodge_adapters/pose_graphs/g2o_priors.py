"""Lines of a g2o file that say something of one vertex: poses and positions known from elsewhere."""

from __future__ import annotations

import numpy as np

from hodge_adapters.pose_graphs.text import Records, write_lines
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints

SPATIAL, SPATIAL_OFFSET, OFFSET = "EDGE_PRIOR_SE3", "EDGE_SE3_PRIOR", "PARAMS_SE3OFFSET"
SPATIAL_XYZ, SPATIAL_XY = "EDGE_SE3_PRIORXYZ", "EDGE_SE3_PRIORXY"
PLANAR, PLANAR_POSITION = "EDGE_PRIOR_SE2", "EDGE_PRIOR_SE2_XY"
KEYS = {SPATIAL: 1, SPATIAL_OFFSET: 2, OFFSET: 1, SPATIAL_XYZ: 1, SPATIAL_XY: 1, PLANAR: 1, PLANAR_POSITION: 1}
COLUMNS = {
    SPATIAL: (28,),
    SPATIAL_OFFSET: (28,),
    OFFSET: (7,),
    SPATIAL_XYZ: (9,),
    SPATIAL_XY: (5,),
    PLANAR: (9,),
    PLANAR_POSITION: (5,),
}
"""`EDGE_SE3_PRIOR` names the sensor's offset on the body after the vertex; the others hold for the body itself.
Positions alone, in space, are what hdl_graph_slam writes of GPS.
"""


def offsets_of(priors: Records, parameters: Records, offsets: Floats) -> Floats:
    """The motion body_from_sensor (P, 4, 4) that each prior names. Raises `SourceError` where it is not one."""
    parameters.refuse_repeated(OFFSET)
    known = {int(key): row for row, key in enumerate(parameters.keys[:, 0])}
    rows = np.array([known.get(int(key), -1) for key in priors.keys[:, 1]], np.int64)
    priors.refuse(rows < 0, f"names a {OFFSET} that the file lacks: add that line")
    return offsets[rows] if len(rows) else np.zeros((0, 4, 4))


def moved_to_body(world_from_sensor: Floats, information: Floats, body_from_sensor: Floats) -> tuple[Floats, Floats]:
    """Poses (P, 4, 4) of the body, and the information (P, 6, 6) on them, of what is known of its sensor."""
    sensor_from_body = se3.inverse(body_from_sensor)
    return world_from_sensor @ sensor_from_body, se3.pull_back(sensor_from_body, information)


def write_priors(lines: list[str], dimension: int, names: Ints, poses: Floats, information: Floats) -> None:
    """Append the lines of priors of vertices `names (P,)`, poses and information in the file's columns."""
    if dimension == 2:
        write_lines(lines, PLANAR, names[:, None], np.hstack([poses, information]))
        return
    lines.append(f"{OFFSET} 0 0 0 0 0 0 0 1")
    keys = np.column_stack([names, np.zeros(len(names), np.int64)])
    write_lines(lines, SPATIAL_OFFSET, keys, np.hstack([poses, information]))
