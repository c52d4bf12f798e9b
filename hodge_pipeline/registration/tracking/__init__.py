"""Frames followed by optical flow, and their poses.

- `tracker`: a block of a long sequence, by `flow` between each `frame` and its key frame, around what is `moving`;
  `blocks` keep it, `repeats` are left out before, and `bridging` closes its breaks after.
- `sightings`: where frames saw the corners of key frames. By them `resection` poses a camera, `readout` and `focal`
  test its shutter and its focal length, and `reposing` poses all frames once key frames are solved. Each point is moved
  to its stamp by `shutter`, and `smoothing` makes the path smooth.
"""
