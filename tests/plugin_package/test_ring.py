"""The package's own test: the contract that every edge builder keeps."""

from hodge_plugin_example import RingEdges

from hodge_pipeline.testing import check_edge_builder


def test_the_ring_keeps_the_contract_of_edge_builders() -> None:
    check_edge_builder(RingEdges())
