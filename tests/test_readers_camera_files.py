from __future__ import annotations

from pathlib import Path

import pytest

from hodge_adapters.images.camera_files import Intrinsics, read_intrinsics
from hodge_pipeline.errors import SourceError

PLAIN = Intrinsics(525.0, 524.0, 319.5, 239.5)
SIZED = Intrinsics(525.0, 524.0, 319.5, 239.5, (640, 480))


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.txt", "# fx fy cx cy\n525 524 319.5 239.5\n", PLAIN),
        ("a.txt", "525 524 319.5 239.5 640 480", SIZED),
        ("a.txt", "5.25e+02 0 319.5\r\n0 524 239.5\r\n0 0 1\r\n", PLAIN),
        ("a.txt", "525\t0\t319.5\t0\n0\t524\t239.5\t0\n0\t0\t1\t0\n0\t0\t0\t1\n", PLAIN),
        ("a.yaml", "%YAML:1.0\nCamera.fx: 525.0\nCamera.fy: 524.0 # y\nCamera.cx: 319.5\nCamera.cy: 239.5\n", PLAIN),
        ("a.yaml", "fx: 525\nfy: 524\ncx: 319.5\ncy: 239.5\nwidth: 640\nheight: 480\n", SIZED),
        ("a.json", '{"width": 640, "height": 480, "intrinsic_matrix": [525, 0, 0, 0, 524, 0, 319.5, 239.5, 1]}', SIZED),
    ],
)
def test_each_form(tmp_path: Path, name: str, text: str, expected: Intrinsics) -> None:
    (tmp_path / name).write_text(text, newline="")
    assert read_intrinsics(tmp_path / name) == expected


def test_orb_slam_files_say_more(tmp_path: Path) -> None:
    lines = "Camera1.fx: 5\nCamera1.fy: 5\nCamera1.cx: 3\nCamera1.cy: 3\nCamera1.k1: 0.26\nDepthMapFactor: 5208.0\n"
    (tmp_path / "a.yaml").write_text(lines)
    found = read_intrinsics(tmp_path / "a.yaml")
    assert found.distorted and found.units_per_metre == 5208.0


def test_of_two_cameras_the_first_is_read(tmp_path: Path) -> None:
    cameras = [("Camera1", "525 524 319.5 239.5 0.26"), ("Camera2", "9 9 9 9 9")]
    names = ("fx", "fy", "cx", "cy", "k1")
    lines = [f"{c}.{name}: {word}" for c, words in cameras for name, word in zip(names, words.split(), strict=True)]
    (tmp_path / "a.yaml").write_text("\n".join(lines) + "\nCamera2.k2: 9.0\n")
    found = read_intrinsics(tmp_path / "a.yaml")
    assert found == Intrinsics(525.0, 524.0, 319.5, 239.5, distorted=True, distortion=(0.26, 0, 0, 0, 0))


@pytest.mark.parametrize("line", ['Camera.type: "KannalaBrandt8"', "Camera1.type: KannalaBrandt8", "Camera1.k4: 0.01"])
def test_a_fisheye_is_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.yaml").write_text(f"%YAML:1.0\n{line}\nfx: 525\nfy: 524\ncx: 319.5\ncy: 239.5\nk1: 0.1\n")
    with pytest.raises(SourceError, match=r"a\.yaml: its lens \((KannalaBrandt8|k4)\) is a fisheye"):
        read_intrinsics(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", ""),
        ("a.txt", "525 525 319.5\n"),
        ("a.txt", "525 525 319.5 239.5 0.1 -0.2\n"),
        ("a.txt", "0 525 319.5 239.5\n"),
        ("a.txt", "nan 525 319.5 239.5\n"),
        ("a.txt", "525 525 inf 239.5\n"),
        ("a.yaml", "fx: 525\nfy: 525\ncx: 320\n"),
        ("a.json", "{"),
        ("a.json", "[]"),
        ("a.json", "[" * 100000),
        ("a.json", '{"width": Infinity, "height": 480, "intrinsic_matrix": [525, 0, 0, 0, 524, 0, 319.5, 239.5, 1]}'),
        ("a.json", f'{{"width": 640, "height": 480, "intrinsic_matrix": [{"9" * 400}, 0, 0, 0, 524, 0, 9, 9, 1]}}'),
        ("a.txt", "fx: 525\nfy: 524\ncx: 319.5\ncy: 239.5\nwidth: 1e999\nheight: 480\n"),
        ("a.txt", "525 524 319.5 239.5 1e300 480\n"),
        ("a.txt", f"m_depthWidth = nan\nm_depthHeight = inf\nm_calibrationDepthIntrinsic = {'1 ' * 16}\n"),
        ("a.json", '{"width": 0, "height": 0, "intrinsic_matrix": [525, 0, 0, 0, 524, 0, 319.5, 239.5, 1]}'),
    ],
)
def test_what_is_no_camera_is_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=name):
        read_intrinsics(tmp_path / name)
