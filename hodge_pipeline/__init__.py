"""Globally consistent registration of many scans by Hodge decomposition on the viewing graph.

Three lines do a whole run, another loads what it left:

    import hodge_pipeline
    run = hodge_pipeline.run("seven_scenes", "runs/kitchen", source="redkitchen")
    print(run.report, run.poses.shape)
    run = hodge_pipeline.Run.load("runs/kitchen")

A few register clouds that are in memory (arrays, or Open3D's) and make their poses consistent:

    edges = hodge_pipeline.register_clouds(clouds, [(0, 1), (1, 2), (0, 2)])
    graph = edges.as_graph(np.arange(len(clouds)))
    world_from_cam = hodge_pipeline.solve_robust(graph).world_from_cam

Two solve a pose graph that is already in arrays, a third says which of its edges are wrong:

    graph = hodge_pipeline.ViewGraph.from_edges(vertex_ids, edges, i_from_j, information)
    world_from_cam = hodge_pipeline.solve(graph).world_from_cam
    print(hodge_pipeline.diagnose(graph).verdict)

One refines the poses of a SLAM system, an array or Open3D's own object, and one a pose graph of Open3D's:

    better = hodge_pipeline.refine_trajectory(world_from_cam, frames).poses
    pose_graph = hodge_pipeline.solve_pose_graph(pose_graph)

One refines a COLMAP model, given as a folder or as pycolmap's own object:

    refined = hodge_pipeline.refine_colmap(reconstruction, database="database.db", depth="depth").models[0]
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hodge_pipeline.cli.console import ProgressBars
    from hodge_pipeline.diagnosis.diagnosis import diagnose
    from hodge_pipeline.diagnosis.result import Diagnosis
    from hodge_pipeline.diagnosis.robust import solve_robust
    from hodge_pipeline.errors import HodgeError
    from hodge_pipeline.recipe.schema import Recipe, load_recipe
    from hodge_pipeline.refine.open3d_objects import solve_pose_graph
    from hodge_pipeline.review.opening import open_review
    from hodge_pipeline.run_folder import Run
    from hodge_pipeline.solvers.covariance import marginal_covariances, relative_covariances
    from hodge_pipeline.solvers.editing import GraphEditor
    from hodge_pipeline.solvers.maximum_likelihood import solve
    from hodge_pipeline.types import (
        Camera,
        Edges,
        Frame,
        PointCloud,
        Priors,
        Registration,
        Solution,
        Source,
        Trajectory,
        ViewGraph,
    )
    from hodge_pipeline.uses.colmap import refine_colmap
    from hodge_pipeline.uses.recipe_run import run, solve_again
    from hodge_pipeline.uses.registration import register, register_clouds
    from hodge_pipeline.uses.sources import open_source
    from hodge_pipeline.uses.trajectory import frames_from_images, refine_trajectory

__all__ = [
    "Camera", "Diagnosis", "Edges", "Frame", "GraphEditor", "HodgeError", "PointCloud", "Priors", "ProgressBars",
    "Recipe", "Registration", "Run", "Solution", "Source", "Trajectory", "ViewGraph", "diagnose", "frames_from_images",
    "load_recipe", "marginal_covariances", "open_review", "open_source", "refine_colmap", "refine_trajectory",
    "register", "register_clouds", "relative_covariances", "run", "solve", "solve_again", "solve_pose_graph",
    "solve_robust",
]  # fmt: skip

_NAMES_IN = {
    "cli.console": ("ProgressBars",),
    "diagnosis.diagnosis": ("diagnose",),
    "diagnosis.result": ("Diagnosis",),
    "errors": ("HodgeError",),
    "recipe.schema": ("Recipe", "load_recipe"),
    "uses.colmap": ("refine_colmap",),
    "refine.open3d_objects": ("solve_pose_graph",),
    "uses.trajectory": ("frames_from_images", "refine_trajectory"),
    "uses.registration": ("register", "register_clouds"),
    "review.opening": ("open_review",),
    "run_folder": ("Run",),
    "solvers.covariance": ("marginal_covariances", "relative_covariances"),
    "solvers.editing": ("GraphEditor",),
    "solvers.maximum_likelihood": ("solve",),
    "diagnosis.robust": ("solve_robust",),
    "uses.recipe_run": ("run", "solve_again"),
    "uses.sources": ("open_source",),
    "types": (
        "Camera", "Edges", "Frame", "PointCloud", "Priors", "Registration", "Solution", "Source", "Trajectory",
        "ViewGraph",
    ),
}  # fmt: skip
_HOMES = {name: home for home, names in _NAMES_IN.items() for name in names}


def __getattr__(name: str) -> Any:
    """The public names, imported when they are first used: `import hodge_pipeline` alone costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'", name=name)
    import importlib

    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, imported or not, and the modules imported so far."""
    return sorted({*globals(), *__all__})
