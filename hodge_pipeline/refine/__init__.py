"""Poses that another program made, made better: by loops, registration and a consistent solve, under a guard."""
