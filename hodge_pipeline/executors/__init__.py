"""Executors: where edges are registered."""
