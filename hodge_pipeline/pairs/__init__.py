"""Edge builders: which pairs of frames to register."""
