"""The uses of the package beside a run: trajectories and models refined, graphs diagnosed, runs recorded again."""
