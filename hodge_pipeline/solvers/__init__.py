"""Consistency solvers: from measured edges to poses."""
