"""Initial poses by global registration: unordered frames or scans, pieces after lost tracking, several sequences."""
