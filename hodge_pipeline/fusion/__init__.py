"""Fusers: one model from all frames."""
