"""ICL-NUIM and Redwood sequences."""
