"""A library that takes signals for itself does not take them from a run."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import pytest


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
