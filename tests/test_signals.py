"""Signals: no library takes them from a run, and Ctrl-C ends a run, not its workers or an import, at any moment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from hodge_pipeline.cli.error_lines import one_line_errors
from hodge_pipeline.executors.local import LocalExecutor


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_term_reaches_its_handler_after_every_reader_and_pycolmap_were_loaded() -> None:
    script = textwrap.dedent("""
        import os, signal, sys
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
        from hodge_pipeline import registry
        for name in registry.names("readers"):
            registry.load("readers", name)
        from hodge_adapters.colmap.pycolmap_import import pycolmap
        assert pycolmap.Camera and "pycolmap" in sys.modules
        os.kill(os.getpid(), signal.SIGTERM)
    """)
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (7, "")


def test_ctrl_c_during_the_import_of_open3d_waits_for_its_end(tmp_path: Path) -> None:
    """Stopped while it starts, open3d ended the command with code 1 and pages of memory statistics."""
    (tmp_path / "open3d.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\nprint('whole')\n")
    script = textwrap.dedent("""
        import signal
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets its background jobs ignore it
        try:
            from hodge_pipeline import lean_open3d
        except KeyboardInterrupt:
            print("stopped")
    """)
    path = os.pathsep.join((str(tmp_path), *filter(None, sys.path)))
    done = subprocess.run(
        [sys.executable, "-c", script],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert (done.stdout.split(), done.stderr) == (["whole", "stopped"], "")


def test_ctrl_c_during_the_import_of_a_compiled_module_is_no_missing_library() -> None:
    with pytest.raises(KeyboardInterrupt), one_line_errors():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise ImportError("initialization failed") from stop


def blocked_signals(_: int) -> set[int]:
    return {int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, ())}


@pytest.mark.skipif(os.name == "nt", reason="Windows blocks no signals")
def test_workers_never_get_the_ctrl_c_of_their_terminal() -> None:
    """Not even while they start, when it ended them with a traceback."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with LocalExecutor(workers=2).open() as workers:
        assert all(signal.SIGINT in blocked for _, blocked in workers.map(blocked_signals, [0, 1]))
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
