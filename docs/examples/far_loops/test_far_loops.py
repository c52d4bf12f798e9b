"""The package's own test: the contract that every edge builder keeps."""

from far_loops import FarLoops

from hodge_pipeline.testing import check_edge_builder


def test_far_loops_keeps_the_contract_of_edge_builders() -> None:
    """Frames without points, one frame, frames named otherwise, and more."""
    check_edge_builder(FarLoops(gap=3))
