"""The motion of one frame, or scan, against another.

- Clouds: `clouds` of frames by `voxel_means`, all in a `cloud_set`; `landmarks` with `descriptors`, by `pixels`.
- Registrars, which begin at a guess: `gicp`, `icp` and `ndt` by `open3d_cloud` in `one_thread`, `rgbd` by `visual`;
  `assessment` says what each found is worth; `in_units` has them serve other units.
- Registration without a guess: `global_*`, `consensus`, `colour_evidence`.
- Many pairs: `pairs`, as a step `register`; which become edges: `acceptance`, `sliding`, `odometry_path`.
- Sequences: `odometry` with `gaps`; `tracking`, a package; scans by `scan_to_map`, `following` and `sweeps`.
"""
