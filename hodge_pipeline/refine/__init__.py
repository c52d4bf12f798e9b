"""Refine the poses of another program (trajectory, COLMAP model, pose graph); a guard never keeps a worse result."""
