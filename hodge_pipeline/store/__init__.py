"""Steps that are computed once and remembered: keys, files, cost, progress."""
