"""Contract checks for every kind of stage, ours and third parties': under `pytest` they show what does not hold.

`CHECKS` has them by the name of the kind. Each makes the small data that it needs, or takes the path of good data.
"""

from collections.abc import Callable, Mapping
from typing import Any

from hodge_pipeline.testing.edge_builders import check_edge_builder
from hodge_pipeline.testing.executors import check_executor
from hodge_pipeline.testing.fusers import check_fuser
from hodge_pipeline.testing.global_registrars import check_global_registrar
from hodge_pipeline.testing.models import check_model_reader
from hodge_pipeline.testing.readers import check_frames, check_reader, check_trajectory, check_view_graph
from hodge_pipeline.testing.registrars import check_registrar
from hodge_pipeline.testing.solvers import check_solver
from hodge_pipeline.testing.starts import check_start
from hodge_pipeline.testing.writers import check_rewriter, check_writer

CHECKS: Mapping[str, Callable[..., Any]] = {
    "readers": check_reader,
    "start": check_start,
    "edges": check_edge_builder,
    "registration": check_registrar,
    "global_registration": check_global_registrar,
    "executors": check_executor,
    "solvers": check_solver,
    "fusion": check_fuser,
    "models": check_model_reader,
    "writers": check_writer,
    "rewriters": check_rewriter,
}
"""The check of each kind of `registry.KINDS`."""

__all__ = [
    "CHECKS", "check_edge_builder", "check_executor", "check_frames", "check_fuser", "check_global_registrar",
    "check_model_reader", "check_reader", "check_registrar", "check_rewriter", "check_solver",
    "check_start", "check_trajectory", "check_view_graph", "check_writer",
]  # fmt: skip
