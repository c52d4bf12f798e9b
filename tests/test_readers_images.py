from __future__ import annotations

import pickle
import struct
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hodge_adapters.images import pixels, png
from hodge_pipeline.errors import SourceError
from readers_data import HEIGHT, WIDTH, depth_values, write_colour, write_depth


def test_depth_is_metres_and_zero_where_the_file_has_none(tmp_path: Path) -> None:
    values = np.array([[0, 1000, 65535], [1, 2500, 65534]], np.uint16)
    depth = pixels.read_depth(
        write_depth(tmp_path / "d.png", values), units_per_metre=1000.0, no_depth=(0, 65535), size=(3, 2)
    )
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[0, 1.0, 0], [0.001, 2.5, 65.534]], rtol=1e-6)


def test_only_the_given_values_mean_no_depth(tmp_path: Path) -> None:
    path = write_depth(tmp_path / "d.png", np.array([[65535, 5000]], np.uint16))
    np.testing.assert_allclose(pixels.read_depth(path, units_per_metre=5000.0), [[13.107, 1.0]], rtol=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colour_is_rgb(tmp_path: Path, suffix: str) -> None:
    colour = pixels.read_colour(write_colour(tmp_path / f"c{suffix}", (200, 100, 50)), size=(WIDTH, HEIGHT))
    assert colour.dtype == np.uint8 and colour.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(colour[2, 3], [200, 100, 50], atol=2)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_orientation_that_an_exif_block_names_turns_no_pixels(tmp_path: Path, suffix: str) -> None:
    """Intrinsics count pixels as they are stored; those that OpenCV turned were then stretched to the camera's size."""
    path, exif = tmp_path / f"phone{suffix}", Image.Exif()
    exif[0x112] = 6  # orientation: the right-hand side is the top
    stored = np.zeros((20, 30, 3), np.uint8)
    stored[:10] = 255
    Image.fromarray(stored).save(path, exif=exif, quality=100)
    read = pixels.read_colour(path, size=(30, 20))
    np.testing.assert_allclose(read.astype(int), stored, atol=40)


def test_encoded_images_are_the_bytes_of_the_file(tmp_path: Path) -> None:
    depth, colour = write_depth(tmp_path / "d.png", depth_values()), write_colour(tmp_path / "c.jpg")
    encoded = pixels.encoded(depth, units_per_metre=5000.0)
    assert (encoded.contents, encoded.media_type, encoded.units_per_metre) == (depth.read_bytes(), "image/png", 5000.0)
    assert pixels.encoded(colour).contents == colour.read_bytes()
    assert pixels.encoded(colour).media_type == "image/jpeg"


def test_a_partial_pickles_and_reads_the_same(tmp_path: Path) -> None:
    read = partial(pixels.read_depth, write_depth(tmp_path / "d.png", depth_values()), units_per_metre=1000.0)
    np.testing.assert_array_equal(read(), pickle.loads(pickle.dumps(read))())


@pytest.mark.parametrize("name", ["image.png", "image.jpg"])
def test_every_truncation_is_found(tmp_path: Path, name: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    whole = cv2.imencode(Path(name).suffix, rgb)[1].tobytes()
    path = tmp_path / name
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(SourceError, match=name):
            pixels.read_colour(path)
    path.write_bytes(whole + b"trailing bytes are harmless")
    assert pixels.read_colour(path).shape == rgb.shape


def test_a_flipped_bit_in_a_png_is_found(tmp_path: Path) -> None:
    path = write_depth(tmp_path / "d.png", depth_values())
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(SourceError, match="damaged"):
        pixels.read_depth(path, units_per_metre=1000.0)


def test_a_thumbnail_does_not_make_a_truncated_jpeg_whole(tmp_path: Path) -> None:
    whole = write_colour(tmp_path / "c.jpg").read_bytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(whole) + 2) + whole
    with_thumbnail = whole[:2] + segment + whole[2:]
    path = tmp_path / "t.jpg"
    path.write_bytes(with_thumbnail)
    assert pixels.read_colour(path).shape == (HEIGHT, WIDTH, 3)
    path.write_bytes(with_thumbnail[:-2])
    with pytest.raises(SourceError, match="truncated"):
        pixels.read_colour(path)


def test_a_size_that_only_the_header_claims_is_refused_before_decoding(tmp_path: Path) -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", 1 << 30, 1 << 30, 16, 0, 0, 0, 0)
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)))
    with pytest.raises(SourceError, match="1073741824x1073741824"):
        pixels.read_depth(path, units_per_metre=1000.0)


def test_another_size_than_the_camera_names_both(tmp_path: Path) -> None:
    path = write_depth(tmp_path / "d.png", depth_values())
    with pytest.raises(SourceError, match=r"d\.png.*8x6.*640x480"):
        pixels.read_depth(path, units_per_metre=1000.0, size=(640, 480))


@pytest.mark.parametrize(
    ("contents", "reason"), [(b"", "empty"), (b"GIF89a", "neither PNG nor JPEG"), (b"\x89PNG\r\n\x1a\n", "neither")]
)
def test_what_is_no_image_is_named(tmp_path: Path, contents: bytes, reason: str) -> None:
    path = tmp_path / "d.png"
    path.write_bytes(contents)
    with pytest.raises(SourceError, match=rf"d\.png.*{reason}"):
        pixels.read_depth(path, units_per_metre=1000.0)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    for path in (tmp_path / "gone.png", tmp_path):
        with pytest.raises(SourceError, match=f"{path.name}: cannot be read"):
            pixels.read_depth(path, units_per_metre=1000.0)


def test_a_colour_image_is_no_depth(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="uint8 with 3 channel"):
        pixels.read_depth(write_colour(tmp_path / "c.png"), units_per_metre=1000.0)


def test_the_common_size_survives_a_damaged_and_an_odd_image(tmp_path: Path) -> None:
    paths = [write_depth(tmp_path / f"{row}.png", depth_values()) for row in range(5)]
    paths[0].write_bytes(b"damaged")
    write_depth(paths[2], depth_values(shape=(3, 3)))
    assert pixels.common_size(paths) == (WIDTH, HEIGHT)
    with pytest.raises(SourceError, match="0.png"):
        pixels.common_size(paths[:1])


def test_a_jpeg_that_was_overwritten_in_part_is_refused(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    for flags in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]):
        path = tmp_path / "image.jpg"
        contents = bytearray(cv2.imencode(".jpg", image, flags)[1].tobytes())
        path.write_bytes(contents + b"\xff\xd9 behind the end")
        assert pixels.read_colour(path).shape == (120, 160, 3)
        contents[-3000:-1000] = np.random.default_rng(1).bytes(2000)
        path.write_bytes(contents)
        with pytest.raises(SourceError, match="truncated or damaged"):
            pixels.read_colour(path)


@pytest.mark.parametrize("kind", ["grey", "depth", "colour", "alpha", "one bit", "palette", "interlaced"])
def test_a_png_inflated_by_isal_decodes_to_the_same_pixels(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("isal", reason="the package isal is not installed")
    picture = np.random.default_rng(0).integers(0, 255, (37, 53, 3)).astype(np.uint8)
    image = Image.fromarray(picture)
    named = {
        "grey": image.convert("L"),
        "depth": Image.fromarray(picture[..., 0].astype(np.uint16) * 257),
        "colour": image,
        "alpha": image.convert("RGBA"),
        "one bit": image.convert("1"),
        "palette": image.convert("P"),
        "interlaced": image,
    }[kind]
    named.save(tmp_path / "x.png")
    contents = (tmp_path / "x.png").read_bytes()
    if kind == "interlaced":  # as the header says, though the data are not
        contents = contents[:28] + b"\x01" + contents[29:]
        assert png._inflated(contents) is None
        return
    parts = png._inflated(contents)
    assert parts is not None
    for how in (cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR_RGB):
        expected = cv2.imdecode(np.frombuffer(contents, np.uint8), how)
        stored = cv2.imdecode(np.frombuffer(png._with_stored(*parts), np.uint8), how)
        np.testing.assert_array_equal(stored, expected)
        np.testing.assert_array_equal(png.decoded(contents, how), expected)


@pytest.mark.parametrize(
    "filters", [cv2.IMWRITE_PNG_FILTER_SUB, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_ALL_FILTERS]
)
@pytest.mark.parametrize("shape", [(37, 53), (37, 53, 3)])
def test_every_filter_of_a_png_is_undone(shape: tuple[int, ...], filters: int) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint16 if len(shape) == 2 else np.uint8)
    contents = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_FILTER, filters])[1].tobytes()
    for how in (cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR_RGB):
        expected = cv2.imdecode(np.frombuffer(contents, np.uint8), how)
        found = png.decoded(contents, how)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_what_cannot_be_inflated_is_left_to_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_depth(tmp_path / "a.png", depth_values())
    contents = path.read_bytes()
    at = contents.index(b"IDAT")
    assert png._inflated(contents[: at + 6] + b"\xff\xff" + contents[at + 8 :]) is None
    assert png._inflated(b"\xff\xd8\xff\xe0 a jpeg") is None
    expected = pixels.read_depth(path, units_per_metre=1000.0)
    monkeypatch.setattr(png, "isal_zlib", None)
    assert png._inflated(contents) is None
    np.testing.assert_array_equal(pixels.read_depth(path, units_per_metre=1000.0), expected)


def test_resampled_colour_lies_between_its_pixels_and_is_black_outside() -> None:
    image = np.array([[[0, 40, 200], [100, 80, 100]]], np.uint8)
    columns, rows = np.array([[0, 0.5, 1, 5]], np.float32), np.zeros((1, 4), np.float32)
    found = pixels.resampled_colour(image, columns, rows)
    np.testing.assert_array_equal(found, [[[0, 40, 200], [50, 60, 150], [100, 80, 100], [0, 0, 0]]])


def test_bytes_behind_a_png_are_left_to_opencv() -> None:
    """A chunk of two bytes behind the last one ended the run with the parser's own error."""
    whole = png.encoded_depth(np.arange(12, dtype=np.uint16).reshape(3, 4))
    if whole is None:
        pytest.skip("isal is not installed")
    expected = cv2.imdecode(np.frombuffer(whole + b"ab", np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png.decoded(whole + b"ab", cv2.IMREAD_UNCHANGED), expected)


def test_a_depth_image_that_is_packed_by_isal_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("isal", reason="the package isal is not installed")
    stored = np.random.default_rng(0).integers(0, 65536, (31, 47)).astype(np.uint16)
    contents = png.encoded_depth(stored)
    assert contents is not None
    (tmp_path / "x.png").write_bytes(contents)
    assert pixels.read_whole_image(tmp_path / "x.png", (47, 31)) == contents
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(contents, np.uint8), cv2.IMREAD_UNCHANGED), stored)
    monkeypatch.setattr(png, "isal_zlib", None)
    assert png.encoded_depth(stored) is None
