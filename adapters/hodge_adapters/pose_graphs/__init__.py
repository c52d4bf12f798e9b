"""Pose graphs: g2o, TORO, and logs of pairs."""
