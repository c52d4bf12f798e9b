"""7-Scenes sequences."""
