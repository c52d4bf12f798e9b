"""Trajectories as text, read, written and corrected."""
