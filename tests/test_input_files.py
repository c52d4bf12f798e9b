"""Input files are opened in one way: regular files alone, at once, read to a limit, expanded no further than needed."""

from __future__ import annotations

import ast
import bz2
import gzip
import lzma
import os
import sqlite3
import struct
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_adapters.clouds.pcd import MAX_EXPANDED_BYTES
from hodge_adapters.colmap.database import database_names
from hodge_adapters.mcap.records import MAGIC
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.types.input_files import beginning, open_input, read_input, read_input_text
from reading_targets import TARGETS

REPOSITORY = Path(__file__).resolve().parents[1]
AT_ONCE_CPU_S = 10.0
"""What hangs takes for ever; what does not, milliseconds."""


def irregular(folder: Path) -> list[Path]:
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    (folder / "link").symlink_to("/dev/zero")
    return [folder / "pipe", folder / "folder", folder / "link", Path("/dev/zero"), folder / "none", folder / "x\0y"]


def test_text_in_utf_16_is_named(tmp_path: Path) -> None:
    for order in ("utf-16-le", "utf-16-be"):
        (tmp_path / "poses.txt").write_bytes("\ufeff1 2 3".encode(order))
        with pytest.raises(OSError, match="is text in UTF-16, as PowerShell writes it: save it as UTF-8"):
            read_input_text(tmp_path / "poses.txt", errors="replace")


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    for path in irregular(tmp_path):
        for read in (open_input, read_input, read_input_text):
            with pytest.raises(OSError) as refused:
                read(path)
            assert refused.value.strerror
        assert beginning(path, 10) == b""


@pytest.mark.parametrize("name", ["drive.mcap", "graph.g2o", "poses.tum"])
def test_a_pointer_of_git_lfs_is_told(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0a1b\nsize 12345\n")
    with pytest.raises(SourceError, match="is a pointer of Git LFS, not the file itself: run git lfs pull$"):
        inspect(path)


@pytest.mark.parametrize("name", ["graph.g2o", "poses.tum"])
def test_a_compressed_file_is_told_whatever_it_is_called(name: str, tmp_path: Path) -> None:
    for compressor, compressed in (
        ("gzip", gzip.compress),
        ("bzip2", bz2.compress),
        ("bzip2", partial(bz2.compress, compresslevel=1)),
        ("xz", lzma.compress),
    ):
        (tmp_path / name).write_bytes(compressed(b"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"))
        with pytest.raises(SourceError, match=f"{name}: is compressed by {compressor}: unpack it first$"):
            inspect(tmp_path / name)


def test_a_file_is_read_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\n")
    assert read_input(path, 8) == path.read_bytes()
    assert read_input_text(path) == "a\nb\n"
    with pytest.raises(OSError, match="holds 8 bytes, the limit is 7"):
        read_input(path, 7)
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 42)
    with pytest.raises(OSError, match="the limit is"):
        read_input(tmp_path / "sparse")


def _opens(node: ast.Call) -> bool:
    """Whether a call reads a file by a way of its own; `reader.open(path)` and files to write are others'."""
    function = node.func
    modes = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
    writes = any(isinstance(mode, str) and mode[:1] in ("w", "a", "x") for mode in modes)
    if isinstance(function, ast.Name):
        return function.id == "open" and not writes
    if not isinstance(function, ast.Attribute):
        return False
    if function.attr == "open" and not writes:
        constants = [mode for mode in modes if isinstance(mode, str)]
        return any(mode in ("r", "rb", "r+b", "rt", "ascii", "utf-8", "utf-8-sig") for mode in constants)
    if function.attr in ("fromfile", "loadtxt", "genfromtxt"):
        return "path" in ast.unparse(node.args[0])
    return function.attr in ("read_text", "read_bytes", "imread")


def test_no_module_opens_input_files_in_a_way_of_its_own() -> None:
    for root in ("hodge_pipeline", "adapters"):
        for path in (REPOSITORY / root).rglob("*.py"):
            if path.name == "input_files.py" or "testing" in path.parts:
                continue
            calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
            lines = [node.lineno for node in calls if _opens(node)]
            assert not lines, f"{path}:{lines}: use hodge_pipeline.types.input_files"


@pytest.mark.parametrize("name", TARGETS)
def test_every_reader_refuses_what_never_ends(name: str, tmp_path: Path) -> None:
    """A pipe or an endless device in the place of each file of its data, in turn."""
    target = TARGETS[name]
    (tmp_path / "good").mkdir()
    path = target.make(tmp_path / "good")
    for file in sorted(file for file in (tmp_path / "good").rglob("*") if file.is_file()):
        contents, kept = file.read_bytes(), file.with_name("kept")
        for put in (os.mkfifo, lambda place: place.symlink_to("/dev/zero"), os.mkdir):
            file.rename(kept)
            put(file)
            start = time.process_time()
            _open_and_read(target.reader, path)
            assert time.process_time() - start < AT_ONCE_CPU_S, f"{file.name} in {put}"
            file.rmdir() if file.is_dir() else file.unlink()
            kept.rename(file)
        assert file.read_bytes() == contents


def _open_and_read(reader: object, path: Path) -> None:
    assert 0 <= reader.sniff(path).confidence <= 1
    try:
        source = reader.open(path)
    except SourceError as error:
        assert "\n" not in str(error)
        return
    for frame in source.frames[:3]:
        for read in filter(None, (frame.read_depth, frame.read_colour, frame.read_points, frame.encoded_depth)):
            try:
                read()
            except SourceError as error:
                assert "\n" not in str(error)


@pytest.mark.parametrize(
    "header",
    [
        "ply\nformat ascii 1.0\nelement other 999999999999999\nelement vertex 1\n",
        "ply\nformat ascii 1.0\nelement vertex 999999999999999\n",
        "ply\nformat binary_little_endian 1.0\nelement other 999999999999999\nproperty int a\nelement vertex 1\n",
        "ply\nformat binary_little_endian 1.0\nelement vertex 999999999999999\n",
    ],
)
def test_counts_of_a_ply_are_not_believed(header: str, tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    coordinates = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"{header}{coordinates}end_header\n1 2 3\n")
    start = time.process_time()
    with pytest.raises(SourceError, match="copy it again"):
        read_fragment(Fragment(path))
    path.write_text(f"{header}end_header\n1 2 3\n")
    with pytest.raises(SourceError):
        read_fragment(Fragment(path))
    assert time.process_time() - start < AT_ONCE_CPU_S


def test_a_pcd_expands_no_further_than_it_may(tmp_path: Path) -> None:
    path, count = tmp_path / "bomb.pcd", MAX_EXPANDED_BYTES // 12 + 1
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {count}\nDATA binary_compressed\n"
    path.write_bytes(head.encode() + struct.pack("<II", 1 << 23, 12 * count) + bytes(1 << 23))
    with pytest.raises(SourceError, match="expands to .* the limit is"):
        read_fragment(Fragment(path))


HOSTILE_TABLES = {
    "endless view": "CREATE VIEW images AS WITH RECURSIVE c(image_id, name) AS (SELECT 1, 'a' UNION ALL SELECT "
    "image_id + 1, 'a' FROM c) SELECT image_id, name FROM c",
    "large view": "CREATE VIEW images AS SELECT 1 AS image_id, zeroblob(900000000) AS name",
    "large generated": "CREATE TABLE images (image_id INTEGER, name AS (zeroblob(900000000)))",
    "made-up table": "CREATE VIRTUAL TABLE images USING fts4(image_id, name)",
}


@pytest.mark.parametrize("statement", HOSTILE_TABLES.values(), ids=HOSTILE_TABLES)
def test_a_database_computes_nothing(statement: str, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    with sqlite3.connect(path) as database:
        database.execute(statement)
        if "VIEW" not in statement:
            database.execute("INSERT INTO images (image_id) VALUES (1)")
    database.close()
    with pytest.raises(SourceError, match="images is no plain table|string or blob too big"):
        database_names(path)


def _zstd_bomb(count: int, size: int) -> bytes:
    import zstandard

    compressed = zstandard.ZstdCompressor(level=1).compress(bytes(size))
    chunk = struct.pack("<QQQII", 0, 0, size, 0, 4) + b"zstd" + struct.pack("<Q", len(compressed)) + compressed
    return MAGIC + (struct.pack("<BQ", 6, len(chunk)) + chunk) * count


def test_the_chunks_of_a_recording_expand_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hodge_adapters.mcap import message_file
    from hodge_adapters.mcap.reader import McapReader

    expanded = list[int]()
    expand: Callable[..., bytes] = message_file.expand
    monkeypatch.setattr(message_file, "expand", lambda *of: expanded.append(of[2]) or expand(*of))
    monkeypatch.setattr(message_file, "ALWAYS_EXPANDED_BYTES", 1 << 24)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(_zstd_bomb(40, 1 << 22))
    with pytest.raises(SourceError):
        McapReader().open(path)
    assert 0 < sum(expanded) <= (1 << 24) + message_file.MAX_EXPANSION * path.stat().st_size
    assert len(expanded) < 40


@pytest.mark.parametrize("word", [b"<!DOCTYPE", b"<!ENTITY"])
def test_the_xml_of_an_e57_defines_nothing(word: bytes, tmp_path: Path) -> None:
    from hodge_adapters.clouds.scan_files import e57_scans

    pytest.importorskip("pye57")
    good = TARGETS["e57"].make(tmp_path)
    path = next(good.rglob("*.e57")) if good.is_dir() else good
    contents = bytearray(path.read_bytes())
    at = contents.index(b"<e57Root")
    contents[at : at + len(word)] = word
    path.write_bytes(contents)
    with pytest.raises(SourceError, match="defines entities"):
        e57_scans(path)
