"""The Rerun recording of a run: the only place that imports rerun."""
