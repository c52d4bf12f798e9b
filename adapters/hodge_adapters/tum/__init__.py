"""TUM RGB-D sequences."""
