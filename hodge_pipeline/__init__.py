"""Globally consistent registration of many scans by Hodge decomposition on the viewing graph.

Three lines do a whole run:

    import hodge_pipeline
    run = hodge_pipeline.run("seven_scenes", "runs/kitchen", source="redkitchen")
    print(run.report, run.result.world_from_cam.shape)

Two solve a pose graph that is already in arrays:

    graph = hodge_pipeline.ViewGraph.from_edges(vertex_ids, edges, i_from_j, information)
    world_from_cam = hodge_pipeline.solve(graph).world_from_cam

One refines the poses of a SLAM system, an array or Open3D's own object, and one a pose graph of Open3D's:

    better = hodge_pipeline.refine_trajectory(world_from_cam, frames).poses
    pose_graph = hodge_pipeline.solve_pose_graph(pose_graph)

One refines a COLMAP model, given as a folder or as pycolmap's own object:

    refined = hodge_pipeline.refine_colmap(reconstruction, database="database.db", depth="depth").models[0]
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hodge_pipeline.pipeline import run
    from hodge_pipeline.recipe.schema import Recipe, load_recipe
    from hodge_pipeline.refine.open3d_objects import solve_pose_graph
    from hodge_pipeline.run_folder import Run
    from hodge_pipeline.solvers.maximum_likelihood import solve
    from hodge_pipeline.types import Solution, ViewGraph
    from hodge_pipeline.uses.colmap import refine_colmap
    from hodge_pipeline.uses.trajectory import frames_from_images, refine_trajectory

__all__ = [
    "Recipe", "Run", "Solution", "ViewGraph", "frames_from_images", "load_recipe", "refine_colmap", "refine_trajectory",
    "run", "solve", "solve_pose_graph",
]  # fmt: skip

_HOMES = {
    "Recipe": "recipe.schema",
    "load_recipe": "recipe.schema",
    "Run": "run_folder",
    "run": "pipeline",
    "refine_colmap": "uses.colmap",
    "refine_trajectory": "uses.trajectory",
    "frames_from_images": "uses.trajectory",
    "solve_pose_graph": "refine.open3d_objects",
    "solve": "solvers.maximum_likelihood",
    "Solution": "types",
    "ViewGraph": "types",
}


def __getattr__(name: str) -> Any:
    """The public names, imported when they are first used: `import hodge_pipeline` alone costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    import importlib

    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
