"""The Rerun recording of a run. Every line of Rerun is in this package."""
