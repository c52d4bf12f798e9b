"""A trusted backbone (odometry) and loops of unknown worth: which loops are right, and the poses that follow."""
