"""Every reader against damaged files: `python tests/fuzz_readers.py 2000` (`make fuzz`); 200 cases each in the tests.

Each case damages one file of good data in one way. A reader may refuse it with `SourceError`; what it opens instead
must be sound: finite, rigid, of the stated size. Memory is limited, so that a lie about a size shows at once.
"""

from __future__ import annotations

import os
import random
import re
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from fuzz_targets import TARGETS
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_trajectory, check_view_graph
from hodge_pipeline.types import PointCloud, Source

MAX_SECONDS = 5.0
MAX_EXTRA_BYTES = 2 << 30
ABSURD = (
    b"\xff" * 4,
    b"\xff" * 8,
    b"\xff\xff\xff\x7f",
    b"\0\0\0\0\0\0\0\x80",
    b"\0" * 4,
    b"\xfe\xff\xff\xff" + b"\xff" * 4,
)
WORDS = (
    b"nan",
    b"inf",
    b"-inf",
    b"-1",
    b"1e308",
    b"1e-320",
    b"9" * 30,
    b"",
    b"0",
    b"../../../etc/passwd",
    b"/etc/passwd",
    b"x\0y",
)
_NUMBER = re.compile(rb"[-+0-9][-+0-9.eE]*")


def damage(contents: bytes, rng: random.Random) -> bytes:
    """The contents, damaged in one way."""
    ways = (_cut, _flip, _absurd, _word, _word, _remove, _repeat, _insert, _text_form, _zero_line, _swap_lines)
    return rng.choice(ways)(contents, rng)


def _at(contents: bytes, rng: random.Random) -> int:
    # Headers are where the lies hurt: half of all damage is done near the beginning.
    return rng.randrange(min(len(contents), 200) if rng.random() < 0.5 else len(contents)) if contents else 0


def _cut(contents: bytes, rng: random.Random) -> bytes:
    borders = [match.end() for match in re.finditer(rb"[\n\0]", contents)] or [0]
    return contents[: rng.choice(borders) if rng.random() < 0.5 else _at(contents, rng)]


def _flip(contents: bytes, rng: random.Random) -> bytes:
    out = bytearray(contents)
    for _ in range(rng.randint(1, 8) if out else 0):
        out[_at(contents, rng)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _absurd(contents: bytes, rng: random.Random) -> bytes:
    at, value = _at(contents, rng) // 4 * 4, rng.choice(ABSURD)
    return contents[:at] + value + contents[at + len(value) :]


def _word(contents: bytes, rng: random.Random) -> bytes:
    found = list(_NUMBER.finditer(contents))
    if not found:
        return _flip(contents, rng)
    match = rng.choice(found)
    return contents[: match.start()] + rng.choice(WORDS) + contents[match.end() :]


def _remove(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    return contents[:at] + contents[at + rng.randint(1, 64) :]


def _repeat(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    end = at + rng.randint(1, 200)
    return contents[:end] + contents[at:]


def _insert(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    return contents[:at] + rng.randbytes(rng.randint(1, 32)) + contents[at:]


def _text_form(contents: bytes, rng: random.Random) -> bytes:
    forms = (
        contents.replace(b".", b","),
        contents.replace(b"\n", b"\r\n"),
        contents.replace(b"\n", b"\r"),
        b"\xef\xbb\xbf" + contents,
        contents.decode("latin-1").encode("utf-16"),
        contents.replace(b" ", b", "),
        b"",
    )
    return rng.choice(forms)


def _zero_line(contents: bytes, rng: random.Random) -> bytes:
    lines = contents.split(b"\n")
    row = rng.randrange(len(lines))
    lines[row] = _NUMBER.sub(b"0", lines[row])
    return b"\n".join(lines)


def _swap_lines(contents: bytes, rng: random.Random) -> bytes:
    lines = contents.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def check_sound(source: Source) -> int:
    """How many images were refused, after asserting that what was opened and read is sound."""
    refused = 0
    assert len(source.frames) or source.trajectory is not None or source.graph is not None, "nothing, silently"
    if source.trajectory is not None:
        check_trajectory(source.trajectory)
    if source.graph is not None:
        check_view_graph(source.graph)
    assert len({frame.frame_id for frame in source.frames}) == len(source.frames), "frame ids repeat"
    for frame in source.frames[:4]:
        assert np.isfinite(frame.stamp_s)
        assert frame.world_from_cam is None or se3.is_motion(frame.world_from_cam, 1e-6)
        for read in filter(None, (frame.read_depth, frame.read_colour, frame.read_points, frame.encoded_depth)):
            try:
                image = read()
            except SourceError:
                refused += 1
                continue
            if read is frame.read_depth:
                assert image.shape == (frame.camera.height, frame.camera.width)
                assert np.isfinite(image).all() and (image >= 0).all()
            if isinstance(image, PointCloud):
                assert np.isfinite(image.points_in_cam).all()
    return refused


@contextmanager
def limited_memory() -> Iterator[None]:
    """Little more memory than there is in use now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MAX_EXTRA_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def fuzz(name: str, cases: int, folder: Path, seed: int = 0) -> Counter[str]:
    """How many cases were read and refused. Raises `AssertionError` that names the case for anything else."""
    target = TARGETS[name]
    path = target.make(folder)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    originals = {file: file.read_bytes() for file in files}
    outcomes: Counter[str] = Counter()
    assert check_sound(target.reader.open(path)) == target.refused, f"{name}: the good data is refused"
    with limited_memory():
        for case in range(cases):
            rng = random.Random(f"{name} {seed} {case}")
            file = rng.choice(files)
            _put(file, originals[file], rng)
            start = time.process_time()
            try:
                assert 0 <= target.reader.sniff(path).confidence <= 1
                refused = check_sound(target.reader.open(path))
                outcomes["refused in part" if refused > target.refused else "read"] += 1
            except SourceError as error:
                assert str(error).strip() and "\n" not in str(error), f"{name} case {case}: no line: {error!r}"
                outcomes["refused"] += 1
            except BaseException as error:
                raise AssertionError(f"{name} case {case} of seed {seed} ({file.name}): {error!r}") from error
            assert time.process_time() - start < MAX_SECONDS, f"{name} case {case} takes too long"
            file.unlink(missing_ok=True)
            file.write_bytes(originals[file])
    return outcomes


def _put(file: Path, original: bytes, rng: random.Random) -> None:
    if rng.random() < 0.01:
        file.unlink()
        if rng.random() < 0.5:
            file.symlink_to(file)
        return
    file.write_bytes(damage(original, rng))


def main() -> None:
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    for name in sys.argv[2:] or TARGETS:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            try:
                outcomes = fuzz(name, cases, Path(folder), seed=int(os.environ.get("HODGE_FUZZ_SEED", "0")))
            except pytest.skip.Exception as skipped:
                print(f"{name:<16} left out: {skipped}")
                continue
            print(f"{name:<16} {dict(outcomes)} {time.process_time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
