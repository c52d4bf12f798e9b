"""Recordings: MCAP, and ROS bags of both generations."""
