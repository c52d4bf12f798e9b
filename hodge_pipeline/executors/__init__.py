"""Executors: where the blocks of a stage run, in processes of this machine or on a cluster."""
