"""Measures of poses: scores of overlapping clouds, trajectory errors, residuals of edges."""
