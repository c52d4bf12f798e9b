"""Contract checks that every stage can be put through, ours and third parties': `pytest` shows what does not hold."""

from hodge_pipeline.testing.readers import check_frames, check_reader, check_trajectory, check_view_graph
from hodge_pipeline.testing.solvers import SOLVER_PROPERTIES, check_solver

__all__ = ["SOLVER_PROPERTIES", "check_frames", "check_reader", "check_solver", "check_trajectory", "check_view_graph"]
