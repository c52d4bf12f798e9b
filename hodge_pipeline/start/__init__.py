"""Initial poses: odometry, key-frame tracking, given poses, LiDAR odometry, or global registration without order."""
