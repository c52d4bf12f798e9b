"""Topology of the viewing graph: complexes, coboundaries, embedding, forms, Hodge decomposition, cycles."""
