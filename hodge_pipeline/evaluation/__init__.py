"""Evaluation: scores, trajectory errors, the report."""
