"""Open3D's trajectories and pose graphs, by their attributes: Open3D itself is not imported."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, ViewGraph


class CameraParameters(Protocol):
    """`open3d.camera.PinholeCameraParameters`."""

    extrinsic: Floats
    intrinsic: Any


class CameraTrajectory(Protocol):
    """`open3d.camera.PinholeCameraTrajectory`: its extrinsics are cam_from_world."""

    parameters: list[CameraParameters]


class PoseGraph(Protocol):
    """`open3d.pipelines.registration.PoseGraph`: an edge moves its source node's points into its target's."""

    nodes: list[Any]
    edges: list[Any]


def poses_of(trajectory: CameraTrajectory) -> Floats:
    """The poses world_from_cam (N, 4, 4) of a camera trajectory."""
    extrinsics = [np.asarray(one.extrinsic, float) for one in trajectory.parameters]
    return se3.inverse(np.array(extrinsics).reshape(-1, 4, 4))


def with_poses(trajectory: CameraTrajectory, world_from_cam: Floats) -> CameraTrajectory:
    """A copy of the trajectory, its cameras kept, with these poses (N, 4, 4)."""
    out = copy.deepcopy(trajectory)
    parameters = list(out.parameters)
    for one, pose in zip(parameters, world_from_cam, strict=True):
        one.extrinsic = se3.inverse(pose)
    out.parameters = parameters
    return out


def graph_of(pose_graph: PoseGraph) -> tuple[ViewGraph, Floats]:
    """The measured graph and the nodes' poses (V, 4, 4) world_from_node. Raises `GraphError` for an edge to no node."""
    poses = np.array([np.asarray(node.pose, float) for node in pose_graph.nodes]).reshape(-1, 4, 4)
    edges = list(pose_graph.edges)
    pairs = np.array([(edge.target_node_id, edge.source_node_id) for edge in edges], np.int64).reshape(-1, 2)
    if len(pairs) and (pairs.min() < 0 or pairs.max() >= len(poses)):
        raise GraphError(f"an edge names a node that is not among the {len(poses)}: mend the pose graph")
    motions = np.array([np.asarray(edge.transformation, float) for edge in edges]).reshape(-1, 4, 4)
    information = np.array([np.asarray(edge.information, float) for edge in edges]).reshape(-1, 6, 6)
    ours = se3.pull_back(motions, information)  # Open3D's information is of a perturbation on the left
    ours = (ours + np.swapaxes(ours, -1, -2)) / 2
    return ViewGraph.from_edges(np.arange(len(poses)), pairs, motions, ours, source="open3d"), poses


def solve_pose_graph(pose_graph: PoseGraph) -> PoseGraph:
    """A copy of Open3D's pose graph with consistent poses, in place of its `global_optimization`.

    Edges that contradict the others, loop closures or not, are left out: their `confidence` becomes 0, that of the
    others 1. The first node keeps its pose. Raises `GraphError` for motions or pairs that are none.
    """
    graph, poses = graph_of(pose_graph)
    solution = solve_robust(replace(graph, fixed=np.zeros(1, np.int64)), start=poses)
    out = copy.deepcopy(pose_graph)
    for node, pose in zip(out.nodes, solution.world_from_cam, strict=True):
        node.pose = pose
    for edge, weight in zip(out.edges, solution.weights, strict=True):
        edge.confidence = float(weight)
    return out
