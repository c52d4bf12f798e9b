"""Every reader against damaged files.

Each case damages one file of good data in one way. A reader may refuse it with `SourceError`; what it opens instead
must be sound (finite, rigid, of the stated size) and hold as much as the good data, except where a note says so or the
damage took records out of a format that counts none. Memory is limited, so that a lie about a size shows at once.
"""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_trajectory, check_view_graph
from hodge_pipeline.types import PointCloud, Source
from reading_targets import TARGETS, Target

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
    held = (source.trajectory, source.graph, source.positions)
    assert len(source.frames) or any(one is not None for one in held), "nothing, silently"
    if source.trajectory is not None:
        check_trajectory(source.trajectory)
    if source.graph is not None:
        check_view_graph(source.graph)
    if source.positions is not None:
        assert np.isfinite(source.positions.points).all()
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


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """For each reader a batch of damaged inputs: target/seed/first/last."""
    return [f"{name}/{seed}/0/{2000 if full else 200}" for name in TARGETS]


def check(name: str, scratch: Path) -> dict[str, int]:
    """How the inputs of a batch ended; `AssertionError` names the one case, as target/seed/case, for anything else."""
    target_name, seed, *numbers = name.split("/")
    first, last = map(int, numbers) if len(numbers) == 2 else (int(numbers[0]), int(numbers[0]) + 1)
    target, folder = TARGETS[target_name], scratch / "reading"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        path = target.make(folder)
    except pytest.skip.Exception as skipped:
        return {f"left out: {skipped}": 1}
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    originals = {file: file.read_bytes() for file in files}
    outcomes: Counter[str] = Counter()
    original = target.reader.open(path)
    assert check_sound(original) == target.refused, f"{target_name}: the good data is refused"
    with limited_memory():
        for case in range(first, last):
            rng = random.Random(f"{target_name} {seed} {case}")
            file = rng.choice(files)
            _put(file, originals[file], rng)
            start = time.process_time()
            try:
                outcomes[_outcome(target, path, original, originals[file], file)] += 1
            except BaseException as error:
                raise AssertionError(f"{target_name}/{seed}/{case} ({file.name}): {error!r}") from error
            assert time.process_time() - start < MAX_SECONDS, f"{target_name}/{seed}/{case} takes too long"
            _clear(file)
            file.write_bytes(originals[file])
    return outcomes


def _outcome(target: Target, path: Path, original: Source, contents: bytes, file: Path) -> str:
    """One word for what became of one damaged input."""
    try:
        assert 0 <= target.reader.sniff(path).confidence <= 1
        opened = target.reader.open(path)
        refused = check_sound(opened)
    except SourceError as error:
        assert str(error).strip() and "\n" not in str(error), f"no line: {error!r}"
        return "refused"
    if refused > target.refused:
        return "refused in part"
    if opened.notes != original.notes:
        return "read with a note"
    if _sizes(opened) == _sizes(original):
        return "read the same" if _same(opened, original) else "read with other values, which nothing forbids"
    now = file.read_bytes() if file.is_file() else b""
    assert not _keeps_its_records(contents, now), f"{_sizes(original)} became {_sizes(opened)} without a note"
    return "read as a shorter or longer file, which nothing forbids"


def _sizes(source: Source) -> tuple[int, ...]:
    """How much a source holds: what becomes less without a word is lost."""
    graph = source.graph
    return (
        len(source.frames),
        -1 if source.trajectory is None else len(source.trajectory),
        *((-1, -1) if graph is None else (graph.vertex_count, graph.edge_count)),
    )


def _same(a: Source, b: Source) -> bool:
    """Whether poses, stamps and edges are equal to the bit; images are compared by their readers' own checks."""
    return all(np.array_equal(one, other, equal_nan=True) for one, other in zip(_numbers(a), _numbers(b), strict=True))


def _numbers(source: Source) -> list[np.ndarray]:
    graph, trajectory = source.graph, source.trajectory
    frames = [np.full((4, 4), np.nan) if f.world_from_cam is None else f.world_from_cam for f in source.frames]
    found = [np.array(frames), np.array([frame.stamp_s for frame in source.frames])]
    found += [] if trajectory is None else [trajectory.stamps_s, trajectory.world_from_cam]
    return found + ([] if graph is None else [graph.edges, graph.i_from_j, graph.information])


def _keeps_its_records(before: bytes, after: bytes) -> bool:
    """Whether a text has as many lines with data as before, so that none may be lost: no format counts cut lines."""
    if b"\0" in before or before[:1] in (b"{", b"[") or not before.strip():
        return False
    return _records(before) == _records(after)


def _records(contents: bytes) -> int:
    lines = contents.replace(b"\r", b"\n").split(b"\n")
    return sum(bool(line.strip()) and not line.lstrip().startswith(b"#") for line in lines)


def _put(file: Path, original: bytes, rng: random.Random) -> None:
    """Damage the file, or put a link to itself, a pipe or an endless device in its place."""
    if rng.random() > 0.02:
        file.write_bytes(damage(original, rng))
        return
    file.unlink()
    way = rng.randrange(4)
    if way == 1:
        file.symlink_to(file)
    elif way == 2:
        os.mkfifo(file)
    elif way == 3:
        file.symlink_to("/dev/zero")


def _clear(file: Path) -> None:
    with suppress(FileNotFoundError):
        file.unlink()
