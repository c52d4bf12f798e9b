"""Open a path: detect its format, describe it, and read the edges that come measured with it."""
