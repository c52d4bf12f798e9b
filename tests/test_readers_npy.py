from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader

POINTS = np.random.default_rng(0).uniform(-9, 9, (40, 3)).astype(np.float32)


def test_arrays_of_numpy_are_scans(tmp_path: Path) -> None:
    np.save(tmp_path / "sweep_0.npy", POINTS)
    np.save(tmp_path / "sweep_1.npy", np.asfortranarray(np.column_stack([POINTS.astype(float), np.arange(40)])))
    names = np.dtype([("intensity", "u1"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])
    records = np.zeros(40, names)
    records["x"], records["y"], records["z"] = POINTS.T
    records["t"] = np.arange(40) * 2_000_000
    np.save(tmp_path / "sweep_2.npy", records)
    np.save(tmp_path / "poses.npy", np.zeros((3, 4, 4)))
    np.save(tmp_path / "labels.npy", np.zeros((40, 3), np.int64))
    source = check_reader(CloudFolderReader(), tmp_path)
    assert [frame.frame_id for frame in source.frames] == ["sweep_0.npy", "sweep_1.npy", "sweep_2.npy"]
    clouds = [frame.read_points() for frame in source.frames]
    for cloud in clouds:
        np.testing.assert_array_equal(cloud.points_in_cam, POINTS)
    np.testing.assert_allclose(clouds[2].times_s, np.arange(40) * 0.002, atol=1e-7)


@pytest.mark.parametrize("damage", ["pickle", "cut", "text", "shape", "header"])
def test_what_no_scan_can_be_read_of_is_said(tmp_path: Path, damage: str) -> None:
    file = tmp_path / "sweep_0.npy"
    np.save(file, np.array([{}]) if damage == "pickle" else np.zeros((3, 40)) if damage == "shape" else POINTS)
    file.write_bytes({"cut": file.read_bytes()[:-8], "text": b"x y z\n1 2 3\n"}.get(damage, file.read_bytes()))
    if damage == "header":
        file.write_bytes(file.read_bytes().replace(b"}", b"(", 1))
    with pytest.raises(SourceError, match=r"sweep_0\.npy: .*(save it again|give rows)"):
        CloudFolderReader().open(file).frames[0].read_points()
