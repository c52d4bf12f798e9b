"""Steps that are computed once: what decides their key, what survives a kill, and what a changed file costs."""

from __future__ import annotations

import errno
import json
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.stages import Step
from hodge_pipeline.store import artifacts
from hodge_pipeline.store import cost as cost_module
from hodge_pipeline.store import store as store_module
from hodge_pipeline.store.store import Store, stored, stored_clouds
from hodge_pipeline.types import CloudSet, Edges, Floats, PointCloud
from hodge_pipeline.types.notes import Note

CALLS: list[str] = []


@dataclass(frozen=True)
class Inner:
    poses: Floats
    name: str | None
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    clouds: CloudSet
    file: Path


def doubled(value: Floats, *, step: Step) -> Floats:
    """A step that is counted, and has something to say."""
    CALLS.append("doubled")
    step.note(Note("fuser", detail=f"doubled {len(value)}"))
    return 2 * value


def total(value: Floats, factor: float, *, step: Step) -> float:
    CALLS.append("total")
    return float(factor * value.sum())


def any_of(*inputs: Any, step: Step) -> int:
    CALLS.append("any_of")
    return len(inputs)


def made_files(seed: int, *, step: Step) -> Made:
    CALLS.append("made_files")
    (step.folder / "model.txt").write_text("model")
    return Made(clouds(seed), step.folder / "model.txt")


def halting(value: Floats, *, step: Step) -> Floats:
    """Fails halfway the first time in its folder."""
    half = step.folder / "half"
    if not half.exists():
        half.write_text("half")
        raise KeyboardInterrupt
    half.unlink()
    return value


def full(*, step: Step) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def clouds(seed: int) -> CloudSet:
    points = np.random.default_rng(seed).normal(size=(30, 3)).astype(np.float32)
    return CloudSet.from_clouds([PointCloud(points[:10]), PointCloud(points[10:])])


@pytest.fixture(autouse=True)
def no_calls() -> None:
    CALLS.clear()


ONE = np.arange(3.0)


def test_a_step_is_computed_once_and_its_notes_are_told_again(tmp_path: Path) -> None:
    for _ in range(2):
        store = Store(tmp_path)
        np.testing.assert_array_equal(store.step(doubled, ONE, title="a"), 2 * ONE)
        assert store.notes == [Note("fuser", detail="doubled 3")]
    assert CALLS == ["doubled"]
    assert not list(tmp_path.rglob("*.part")) and not list(tmp_path.rglob(".*"))
    np.testing.assert_array_equal(stored(tmp_path, doubled), [2 * ONE])
    assert stored(tmp_path, total) == [] == stored(tmp_path / "nothing", total)


def test_a_value_that_nobody_holds_is_let_go(tmp_path: Path) -> None:
    """Of a long run each table of edges has 40 to 80 MB."""
    store = Store(tmp_path)
    held, dropped = (store.step(doubled, factor * ONE, title="a") for factor in (1, 2))
    known, watched = store.key(held), weakref.ref(dropped)
    del dropped
    assert watched() is None
    assert store.key(held) == known != store.key(held.copy())


def test_each_call_of_a_run_is_a_step_of_its_own(tmp_path: Path) -> None:
    for _ in range(2):
        store = Store(tmp_path)
        assert [store.step(total, ONE, factor, title="t") for factor in (1.0, 2.0, 1.0)] == [3.0, 6.0, 3.0]
    assert CALLS == ["total"] * 3 and stored(tmp_path, total) == [3.0, 6.0, 3.0]


INPUTS: list[tuple[Any, Any]] = [
    (ONE, ONE + 1e-12),
    (ONE, ONE.astype(np.float32)),
    (ONE, ONE[:, None]),
    (1.0, 2.0),
    ("1", 1),
    (None, 0),
    (b"a", b"b"),
    ([1, 2], [2, 1]),
    ({"a": 1}, {"a": 2}),
    (Gicp(), Gicp(distances_m=(0.3,), source_points=(100,))),
    (Inner(ONE, "a"), Inner(ONE, "b")),
    (Edges.of([[0, 1]]), Edges.of([[0, 2]])),
    (clouds(0), clouds(1)),
]


@pytest.mark.parametrize("pair", INPUTS, ids=lambda pair: type(pair[0]).__name__)
def test_every_input_and_its_type_is_part_of_the_key(tmp_path: Path, pair: tuple[Any, Any]) -> None:
    for value in (*pair, pair[1]):
        Store(tmp_path).step(any_of, value, title="a")
    assert CALLS == ["any_of"] * 2


def read_whole(clouds: CloudSet, *, step: Step) -> float:
    return float(clouds.points.sum())


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="nothing says how much of a file is in memory")
def test_the_memory_of_what_a_step_read_of_clouds_is_given_back(tmp_path: Path) -> None:
    store = Store(tmp_path)
    made = store.step(made_files, 3, title="a").clouds
    store.remember(made, "clouds")
    store.step(read_whole, made, title="b")
    mapping = Path("/proc/self/smaps").read_text().split(f"{made.points.filename}\n", 1)[1]  # other tests map theirs
    assert "Rss:                   0 kB" in mapping.split("VmFlags", 1)[0]


def test_a_file_counts_by_its_contents(tmp_path: Path) -> None:
    file = tmp_path / "input.txt"
    for text in ("one", "two", "two"):
        file.write_text(text)
        Store(tmp_path / "s").step(any_of, file, title="a")
    assert CALLS == ["any_of"] * 2


def test_another_version_of_a_library_computes_again_but_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store(tmp_path).step(doubled, ONE, title="a")
    monkeypatch.setattr(store_module, "versions", lambda: {"numpy": "99"})
    np.testing.assert_array_equal(stored(tmp_path, doubled), [2 * ONE])
    Store(tmp_path).step(doubled, ONE, title="a")
    assert CALLS == ["doubled"] * 2


def test_what_would_have_another_key_in_every_process_is_refused(tmp_path: Path) -> None:
    for value in (object(), lambda: 0, np.array([object()]), Inner(ONE, print)):  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="has no key"):
            Store(tmp_path).step(any_of, value, title="a")
    store, unnamed = Store(tmp_path), object()
    store.remember(unnamed, "its key")
    assert store.step(any_of, unnamed, title="a") == 1


def test_the_key_of_a_steps_result_stands_for_its_contents(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = store.step(doubled, ONE, title="a")
    assert store.key(first) != store.key(first.copy())
    store.step(total, first, 1.0, title="b")
    store = Store(tmp_path)
    store.step(total, store.step(doubled, ONE, title="a"), 1.0, title="b")
    assert CALLS == ["doubled", "total"]
    store = Store(tmp_path)
    store.step(total, store.step(doubled, ONE + 1, title="a"), 1.0, title="b")
    assert CALLS == ["doubled", "total"] * 2


def test_a_killed_step_goes_on_in_its_folder_under_its_key_alone(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        Store(tmp_path).step(halting, ONE, title="a")
    assert (tmp_path / "halting-1.part" / "half").is_file()
    with pytest.raises(KeyboardInterrupt):
        Store(tmp_path).step(halting, ONE + 1, title="a")
    np.testing.assert_array_equal(Store(tmp_path).step(halting, ONE + 1, title="a"), ONE + 1)
    assert sorted(path.name for path in (tmp_path / "halting-1").iterdir()) == ["step.json", "value.json", "value.npz"]
    assert not list(tmp_path.glob("*.part"))


def test_the_old_result_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    def last() -> Floats:
        return np.load(tmp_path / "halting-1/value.npz")["array"]

    for _ in range(2):
        try:
            Store(tmp_path).step(halting, ONE, title="a")
        except KeyboardInterrupt:
            continue
    with pytest.raises(KeyboardInterrupt):
        Store(tmp_path).step(halting, ONE + 1, title="a")
    np.testing.assert_array_equal(last(), ONE)


def test_a_full_disk_keeps_what_was_finished(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.step(doubled, ONE, title="a")
    with pytest.raises(WorkspaceError, match="make room"):
        store.step(full, title="b")
    np.testing.assert_array_equal(stored(tmp_path, doubled), [2 * ONE])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def empty(path: Path) -> None:
    path.write_bytes(b"")


DAMAGE: list[Callable[[Path], None]] = [flip, empty, Path.unlink]


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: damage.__name__)
def test_a_damaged_file_of_a_step_is_said_refused_and_healed(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    Store(tmp_path).step(made_files, 1, title="a")
    files = sorted(path for path in (tmp_path / "made_files-1").rglob("*") if path.is_file())
    assert {path.name for path in files} >= {"model.txt", "step.json", "value.json", "points.npy", "offsets.npy"}
    for file in files:
        CALLS.clear()
        if file.stat().st_size:
            damage(file)
        for read in (lambda: stored(tmp_path, made_files), lambda: stored_clouds(tmp_path)):
            with pytest.raises(WorkspaceError, match=f"{file.name} .*the same hodge run computes it again") as refused:
                read()
            assert "\n" not in str(refused.value)
        store = Store(tmp_path)
        made = store.step(made_files, 1, title="a")
        assert CALLS == ["made_files"]
        assert len(store.notes) == 1 and file.name in str(store.notes[0]) and "computed again" in str(store.notes[0])
        assert made.file.read_text() == "model"
        np.testing.assert_array_equal(made.clouds.points, clouds(1).points)
    assert len(stored(tmp_path, made_files)) == len(stored_clouds(tmp_path)) == 1


@pytest.mark.parametrize("damage", [flip, empty])
def test_a_damaged_list_of_steps_is_refused(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    Store(tmp_path).step(doubled, ONE, title="a")
    damage(tmp_path / "index.json")
    with pytest.raises(WorkspaceError, match="index.json has changed"):
        stored(tmp_path, doubled)


def test_costs_are_those_of_the_run_that_computed_it_and_are_added_by_title(tmp_path: Path) -> None:
    for _ in range(2):
        store = Store(tmp_path)
        for factor in (1.0, 2.0):
            store.step(total, ONE, factor, title="t")
    (cost,) = store.costs()
    parts = [json.loads(path.read_text())["cost"] for path in tmp_path.glob("*/step.json")]
    assert cost["title"] == "t" and len(parts) == 2
    assert cost["wall_s"] == pytest.approx(sum(part["wall_s"] for part in parts))
    assert cost["peak_mb"] == max(part["peak_mb"] for part in parts) > 1


def test_shared_pages_of_workers_are_counted_again_only_when_memory_has_grown(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, workers = list[int](), [cost_module.psutil.Process()]
    one = SimpleNamespace(rss=50_000_000)
    monkeypatch.setattr(cost_module.psutil.Process, "memory_info", lambda process: one)
    monkeypatch.setattr(cost_module.psutil.Process, "children", lambda process, recursive: workers)
    monkeypatch.setattr(cost_module, "_memory_bytes", lambda process: looks.append(one.rss) or one.rss // 2)
    monitor, peaks = cost_module.Monitor(), []
    for one.rss in (50_000_000, 50_500_000, 100_000_000, 40_000_000):
        with monitor.measure() as spent:
            pass
        peaks.append(spent.peak_mb)
    assert looks == [50_000_000] * 2 + [100_000_000] * 2  # of each process
    workers.clear()
    with monitor.measure() as spent:
        pass
    assert [*peaks, spent.peak_mb] == [50.0, 50.5, 100.0, 40.0, 40.0] and len(looks) == 4


def test_a_stage_looks_at_all_processes_once_and_counts_those_that_began_in_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At its end: it begins with those that the last one ended with."""
    looks, worker = list[int](), cost_module.psutil.Process(1)
    spent_s = dict.fromkeys((os.getpid(), worker.pid), 0.0)
    monkeypatch.setattr(cost_module, "SAMPLE_SECONDS", 1e6)
    monkeypatch.setattr(
        cost_module.psutil.Process, "cpu_times", lambda one: SimpleNamespace(user=spent_s[one.pid], system=0)
    )
    monkeypatch.setattr(
        cost_module.psutil.Process, "children", lambda one, recursive: looks.append(one.pid) or [worker]
    )
    monitor = cost_module.Monitor()
    for in_stage, between in ((2.0, 3.0), (5.0, 0.0)):
        with monitor.measure() as cost:
            spent_s[worker.pid] += in_stage
        assert cost.cpu_s == in_stage
        spent_s[worker.pid] += between
    assert len(looks) == 2


def test_a_file_of_two_names_leaves_no_draft(tmp_path: Path) -> None:
    (tmp_path / "made").write_text("x")
    for _ in range(2):
        artifacts.link_or_copy(tmp_path / "made", tmp_path / "shown")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made", "shown"]
