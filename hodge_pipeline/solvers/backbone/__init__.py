"""A trusted backbone (odometry) and loop closures that may be wrong: which are right, and the poses that follow."""
