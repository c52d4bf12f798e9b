"""The demo's data: rooms rendered as TUM sequences, and a street scanned by a LiDAR, all modelled in code."""
