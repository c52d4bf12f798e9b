"""Open3D's JSON: pose graphs and camera trajectories. Its conventions are met here and nowhere else.

Matrices are stored by columns. An edge (source i, target j) holds `j_from_i`; its information is of a perturbation on
the left, in the target's axes, rotation first. A camera's extrinsic is cam_from_world.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.images.headers import MAX_SIDE
from hodge_adapters.json_files import motion, numbers, objects, read_json, whole, write_json
from hodge_adapters.posed import graph_of, trajectory_of, written, written_graph
from hodge_adapters.text_rows import first_text
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Camera, Floats, Frame, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted

GRAPH, TRAJECTORY = "PoseGraph", "PinholeCameraTrajectory"
CERTAIN, UNCERTAIN = "open3d", "open3d_uncertain"
VERSION = {"version_major": 1, "version_minor": 0}


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Open3dReader:
    """Opens a pose graph or a camera trajectory that Open3D wrote."""

    def sniff(self, path: Path) -> Sniff:
        """By the class that the file names near its beginning, or the keys that such a class begins with."""
        text = first_text(Path(path))
        for name in (GRAPH, TRAJECTORY):
            if text.lstrip().startswith("{") and f'"{name}' in text:
                return Sniff(0.95, f"class_name {name}")
        return Sniff(0.0, "no JSON of Open3D")

    def open(self, path: Path) -> Source:
        """A graph with its nodes' poses as trajectory, or posed frames with a camera and no images.

        Stamps and ids are the row numbers. Raises `SourceError` that names the node, edge or camera.
        """
        path = Path(path)
        content = read_json(path)
        kind = content.get("class_name")
        if kind == GRAPH:
            return _open_graph(path, content)
        if kind == TRAJECTORY:
            return _open_trajectory(path, content)
        raise SourceError(f"{path}: class_name is {str(kind)[:40]!r}, not {GRAPH} or {TRAJECTORY}: is it another file?")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Open3dPoseGraphWriter:
    """Writes a measured graph as Open3D's pose graph, with the trajectory's poses where it has one for each vertex."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically. Edges of neighbouring vertices are certain, others uncertain, unless they came so."""
        graph, known = graph_of(source)
        poses = np.broadcast_to(np.eye(4), (graph.vertex_count, 4, 4)) if known is None else known
        content = {
            "class_name": GRAPH,
            "edges": _edge_objects(graph),
            "nodes": [{"class_name": "PoseGraphNode", "pose": _by_columns(pose), **VERSION} for pose in poses],
            **VERSION,
        }
        write_json(Path(path), content)
        return written_graph(source, graph)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Open3dTrajectoryWriter:
    """Writes posed frames as Open3D's PinholeCameraTrajectory."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically. Stamps are lost; a source without cameras gets intrinsics of size 0, which Open3D
        takes for unknown.
        """
        posed = [frame for frame in source.frames if frame.world_from_cam is not None]
        poses = [frame.world_from_cam for frame in posed] or list(trajectory_of(source).world_from_cam)
        cameras = [frame.camera for frame in posed] or [None] * len(poses)
        content = {
            "class_name": TRAJECTORY,
            "parameters": [
                {
                    "class_name": "PinholeCameraParameters",
                    "extrinsic": _by_columns(se3.inverse(np.asarray(pose))),
                    "intrinsic": _intrinsic(camera),
                    **VERSION,
                }
                for pose, camera in zip(poses, cameras, strict=True)
            ],
            **VERSION,
        }
        write_json(Path(path), content)
        return written(counted(len(poses), "pose"), source, {"cameras"})


def information_of_open3d(j_from_i: Floats, information: Floats) -> Floats:
    """Ours, over `j_from_i · exp(ξ)`, of Open3D's (E, 6, 6), over `exp(ξ) · j_from_i`: ξ_left = Ad ξ_right."""
    moved = se3.pull_back(j_from_i, information)
    return np.asarray((moved + np.swapaxes(moved, -1, -2)) / 2)


def _open_graph(path: Path, content: dict[str, Any]) -> Source:
    nodes = objects(content.get("nodes"), f"{path}: nodes")
    if not nodes:
        raise SourceError(f"{path}: a pose graph without nodes: give one that has some")
    poses = np.array([motion(node.get("pose"), f"{path}: node {row}", columns=True) for row, node in enumerate(nodes)])
    edges = objects(content.get("edges"), f"{path}: edges")
    ends, motions, information, names = [], [], [], []
    for row, edge in enumerate(edges):
        where = f"{path}: edge {row}"
        pair = [whole(edge.get(f"{end}_node_id"), 0, len(nodes)) for end in ("target", "source")]
        if None in pair:
            raise SourceError(f"{where}: names a node that is not there: mend or remove it")
        matrix = numbers(edge.get("information"), 36, where).reshape(6, 6)
        if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-6 * np.abs(matrix).max()):
            raise SourceError(f"{where}: its information is not symmetric: mend or remove it")
        ends.append(pair)
        motions.append(motion(edge.get("transformation"), where, columns=True))
        information.append((matrix + matrix.T) / 2)
        names.append(UNCERTAIN if edge.get("uncertain") is True else CERTAIN)
    i_from_j = np.array(motions).reshape(-1, 4, 4)
    with np.errstate(over="ignore", invalid="ignore"):
        ours = information_of_open3d(i_from_j, np.array(information).reshape(-1, 6, 6))
    if not np.isfinite(ours).all():
        raise SourceError(f"{path}: an edge's information is too large for a number: mend the file")
    rows = np.array(ends, np.int64).reshape(-1, 2)
    graph = ViewGraph.from_edges(np.arange(len(nodes)), rows, i_from_j, ours)
    graph = replace(graph, source=np.array(names, np.str_).reshape(-1))
    trajectory = Trajectory(np.arange(len(nodes), dtype=float), poses, has_stamps=False)
    return Source(path.stem, path, trajectory=trajectory, graph=graph, files=(path,), of_cameras=True)


def _open_trajectory(path: Path, content: dict[str, Any]) -> Source:
    frames = []
    for row, parameters in enumerate(objects(content.get("parameters"), f"{path}: parameters")):
        where = f"{path}: camera {row}"
        pose = se3.inverse(motion(parameters.get("extrinsic"), where, columns=True))
        frames.append(Frame(row, float(row), _camera(parameters.get("intrinsic"), where), world_from_cam=pose))
    if not frames:
        raise SourceError(f"{path}: a trajectory without cameras: give one that has some")
    stamps = np.arange(len(frames), dtype=float)
    trajectory = Trajectory(stamps, np.array([frame.world_from_cam for frame in frames]), has_stamps=False)
    return Source(path.stem, path, tuple(frames), trajectory, files=(path,))


def _camera(intrinsic: Any, where: str) -> Camera | None:
    """The camera, None where its size is unknown."""
    if not isinstance(intrinsic, dict):
        return None
    width, height = (whole(intrinsic.get(side), 1, MAX_SIDE) for side in ("width", "height"))
    if width is None or height is None:
        return None
    k = numbers(intrinsic.get("intrinsic_matrix"), 9, where)
    if k[0] <= 0 or k[4] == 0:
        raise SourceError(f"{where}: its focal length is not positive: mend the file")
    return Camera(width, height, k[0].item(), k[4].item(), k[6].item(), k[7].item())


def _intrinsic(camera: Camera | None) -> dict[str, Any]:
    if camera is None:
        return {"height": -1, "width": -1, "intrinsic_matrix": np.eye(3).ravel().tolist()}
    return {"height": camera.height, "width": camera.width, "intrinsic_matrix": camera.matrix.T.ravel().tolist()}


def _edge_objects(graph: ViewGraph) -> list[dict[str, Any]]:
    theirs = information_of_open3d(se3.inverse(graph.i_from_j), graph.information)
    known = {CERTAIN: False, UNCERTAIN: True}
    return [
        {
            "class_name": "PoseGraphEdge",
            "confidence": 1.0,
            "information": information.ravel().tolist(),
            "source_node_id": int(j),
            "target_node_id": int(i),
            "transformation": _by_columns(matrix),
            "uncertain": known.get(str(name), abs(int(i) - int(j)) != 1),
            **VERSION,
        }
        for (i, j), matrix, information, name in zip(graph.edges, graph.i_from_j, theirs, graph.source, strict=True)
    ]


def _by_columns(matrix: Floats) -> list[float]:
    return [float(value) for value in (matrix.T + 0.0).ravel()]
