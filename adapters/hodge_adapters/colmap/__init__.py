"""COLMAP models and databases: read, refined and written."""
