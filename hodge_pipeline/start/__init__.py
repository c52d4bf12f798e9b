"""Where the first poses of a run come from."""
