"""PLY files: what is written is read again, by this project and by open3d; malformed files are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Model
from hodge_pipeline.types.output_files import replacing
from hodge_pipeline.types.ply import model_parts, read_model


def model_of(count: int, normals: bool = True, colours: bool = True, triangles: int | None = None) -> Model:
    rng = np.random.default_rng(count)
    return Model(
        name="scene",
        points_in_world=rng.normal(size=(count, 3)).astype(np.float32),
        normals_in_world=rng.normal(size=(count, 3)).astype(np.float32) if normals else None,
        colours=rng.integers(0, 256, (count, 3)).astype(np.uint8) if colours else None,
        triangles=None if triangles is None else rng.integers(0, count, (triangles, 3)).astype(np.int32),
        notes=("3 frames skipped: no finite pose", "größer als erlaubt"),
    )


def write_ply(path: Path, model: Model) -> None:
    with replacing(path) as file:
        file.writelines(model_parts(model))


def assert_same(a: Model, b: Model) -> None:
    assert (a.name, a.notes) == (b.name, b.notes)
    for name in ("points_in_world", "normals_in_world", "colours", "triangles"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None)
        if x is not None:
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


@given(count=st.integers(1, 30), normals=st.booleans(), colours=st.booleans(), triangles=st.none() | st.integers(0, 9))
@settings(max_examples=30, deadline=None)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, count: int, normals: bool, colours: bool, triangles: int | None
) -> None:
    path = tmp_path_factory.mktemp("ply") / "x.ply"
    model = model_of(count, normals, colours, triangles)
    write_ply(path, model)
    assert_same(model, read_model(path))
    assert [file.name for file in path.parent.iterdir()] == ["x.ply"]


def test_an_empty_model_is_a_file_too(tmp_path: Path) -> None:
    write_ply(tmp_path / "x.ply", model_of(0))
    assert_same(model_of(0), read_model(tmp_path / "x.ply"))


def test_open3d_reads_it(tmp_path: Path) -> None:
    model = model_of(50, triangles=20)
    write_ply(tmp_path / "x.ply", model)
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "x.ply"))
    np.testing.assert_allclose(np.asarray(mesh.vertices), model.points_in_world)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), model.normals_in_world)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors) * 255, model.colours, atol=1e-9)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), model.triangles)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    write_ply(path, model_of(5))
    with pytest.raises(ValueError, match="broadcast"):
        write_ply(path, Model("bad", np.zeros((5, 3), np.float32), triangles=np.zeros((4, 2), np.int32)))
    assert_same(model_of(5), read_model(path))
    assert list(tmp_path.iterdir()) == [path]


HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"


@pytest.mark.parametrize(
    ("contents", "complaint"),
    [
        (b"", "no PLY header"),
        (b"solid x\n", "no PLY header"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "format ascii"),
        (b"ply\n" * 2000, "no PLY header"),
        (HEADER, "no PLY header"),
        (HEADER + b"end_header\n" + b"\0" * 16, "no z"),
        (HEADER + b"property float z\nend_header\n" + b"\0" * 23, "has 23 bytes for them"),
        (HEADER + b"property float z\nelement face x\nend_header\n", "element face x"),
    ],
)
def test_malformed_files_are_named(tmp_path: Path, contents: bytes, complaint: str) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(contents)
    with pytest.raises(SourceError, match=complaint) as error:
        read_model(path)
    assert "broken.ply" in str(error.value)


def test_the_points_of_a_model_are_read_as_those_of_a_scan(tmp_path: Path) -> None:
    """One codec: what fusion wrote is a scan for the next run, whatever element follows the vertices."""
    model = model_of(40, triangles=7)
    write_ply(tmp_path / "x.ply", model)
    found = read_fragment(Fragment(tmp_path / "x.ply"))
    np.testing.assert_array_equal(found.points_in_cam, model.points_in_world)
    np.testing.assert_array_equal(found.colours, model.colours)
    cut = (tmp_path / "x.ply").read_bytes()[:-1]
    (tmp_path / "cut.ply").write_bytes(cut)
    with pytest.raises(SourceError, match="says 7 triangles"):
        read_model(tmp_path / "cut.ply")
