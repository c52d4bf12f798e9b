"""Run the `rerun` binary (viewer, screenshots) with its telemetry off."""

from __future__ import annotations

import os
import subprocess
from importlib.resources import files
from pathlib import Path

TIMEOUT_S = 120.0


def program() -> Path:
    """Path of the `rerun` binary; the `rerun` on PATH is a wrapper that leaves it running when killed."""
    name = "rerun.exe" if os.name == "nt" else "rerun"
    return Path(os.environ.get("RERUN_CLI_PATH") or str(files("rerun_cli") / name))


def quiet_environment(scratch: Path) -> dict[str, str]:
    """An environment in which the program keeps its settings in `scratch`, telemetry disabled there."""
    environment = os.environ | {
        "HOME": str(scratch),
        "XDG_CONFIG_HOME": str(scratch / "config"),
        "XDG_DATA_HOME": str(scratch / "data"),
        "XDG_CACHE_HOME": str(scratch / "cache"),
        "APPDATA": str(scratch / "appdata"),
        "LOCALAPPDATA": str(scratch / "localappdata"),
    }
    run(["analytics", "disable"], environment)
    return environment


def run(arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """The finished process; raises `subprocess.CalledProcessError` where it failed, `OSError` where it is missing."""
    return subprocess.run(
        [str(program()), *arguments], env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=True
    )
