"""Images, cameras and lenses, as several formats need them."""
