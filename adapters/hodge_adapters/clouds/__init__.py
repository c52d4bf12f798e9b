"""Folders of point clouds, one module for each kind of file."""
