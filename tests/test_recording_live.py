"""A viewer on this machine: it gets every part of a run as it is recorded, or serves a recording as a page."""

from __future__ import annotations

import time
import urllib.request
from pathlib import Path

import pytest

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import layout, live
from hodge_pipeline.recording.merge import find_parts
from recording_data import circle, record, record_all, rows
from test_recording_run import entities

TRIES = 120


def merged_when_it_holds(wanted: set[str], saved: Path) -> Path:
    """What a listener saved, as one good recording: it writes what it received a moment later, so look again."""
    mended = saved.with_name("mended.rrd")
    merge = ["rrd", "merge", "--continue-on-error", str(saved), "-o", str(mended)]
    for _ in range(TRIES):
        live.run_program(merge, live.quiet_environment(saved.parent))
        if entities(mended) >= wanted:
            return mended
        time.sleep(0.5)
    raise AssertionError(f"{wanted - entities(mended)} never came")


def test_a_viewer_gets_each_part_once(tmp_path: Path) -> None:
    port, saved = live.free_port(0), tmp_path / "saved.rrd"
    flags = ["--bind", live.HOST, "--port", str(port), "--save", str(saved)]
    listener = live.start(flags, live.quiet_environment(tmp_path))
    try:
        live.wait_for(port, listener)
        shown = live.Live(f"rerun+http://{live.HOST}:{port}/proxy", "run-1")
        record(tmp_path / "parts").poses("odometry", circle())
        shown.show(find_parts(tmp_path / "parts"))
        record_all(record(tmp_path / "parts"))
        shown.show(find_parts(tmp_path / "parts"))
        shown.close()
        mended = merged_when_it_holds({layout.COLOUR, layout.FILM_EDGES, layout.MODEL, layout.LEGEND}, saved)
    finally:
        listener.terminate()
        listener.wait()
    assert len(rows(mended, layout.poses("odometry"), layout.FRAME)) == 12


def test_a_recording_is_served_on_this_machine_alone(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts")
    record_all(recorder)
    recorder.finish(tmp_path / "recording.rrd")
    with live.served([tmp_path / "recording.rrd"]) as (address, page):
        assert address.startswith("rerun+http://127.0.0.1:") and page.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(page) as answer:
            assert answer.status == 200
        port = int(page.split(":")[2].split("/")[0])
        assert live.answers(port)
    assert not live.answers(port)


def test_a_viewer_that_does_not_start_is_one_line(tmp_path: Path) -> None:
    ended = live.start(["--no-such-flag"], live.quiet_environment(tmp_path))
    ended.wait()
    with pytest.raises(WorkspaceError, match="does not start"):
        live.wait_for(live.free_port(0), ended)


def test_the_viewer_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "nothing"))
    with pytest.raises(WorkspaceError, match="not installed"):
        live.start([])
