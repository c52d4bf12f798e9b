"""Stream a running run to a viewer on this machine, part by part; run its program with telemetry off."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import legend, make_blueprint
from hodge_pipeline.recording.merge import contents_of, eyes, readers_of, send, with_entities
from hodge_pipeline.recording.stream import log_markdown, open_stream

HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090
"""Those of Rerun, for data and for the page."""
START_S = 60.0
"""That a viewer may take until it listens."""
TIMEOUT_S = 120.0
"""That a call of the viewer may take: twice what it may take to start."""


class Live:
    """Sends the parts of one recording to a viewer as they are finished."""

    def __init__(self, address: str, recording_id: str) -> None:
        self._stream = open_stream(recording_id)
        self._stream.connect_grpc(address)
        self._sent: set[Path] = set()

    def show(self, parts: Sequence[Path]) -> None:
        """Send the parts that were not sent yet; the views follow what there is."""
        readers = readers_of(parts)
        contents = with_entities(contents_of(parts), readers.values())
        for part, reader in readers.items():
            if part not in self._sent:
                send(self._stream, reader, layout.poses(contents.trajectory))
                self._sent.add(part)
        log_markdown(self._stream, layout.LEGEND, legend(contents))
        self._stream.send_blueprint(make_blueprint(contents, eyes(contents, readers.values())))
        self._stream.flush()

    def close(self) -> None:
        """Wait until all is sent."""
        self._stream.flush()
        self._stream.disconnect()


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def viewer() -> Iterator[tuple[str, str]]:
    """The address of a viewer, and a line that says where it is seen: one that runs already, a window of its own, or,
    without a screen, a page on this machine that ends with the block. Raises `WorkspaceError` where none starts.
    """
    address = f"rerun+http://{HOST}:{PORT}/proxy"
    if answers(PORT):
        yield address, f"the viewer that listens on {HOST}:{PORT}"
    elif has_screen():
        process = start(["--bind", HOST, "--port", str(PORT), "--expect-data-soon"])
        wait_for(PORT, process)
        yield address, "a window of its own"
    else:
        with served(()) as (address, page):
            yield address, page


@contextmanager
def served(recordings: Sequence[Path], *, opens_browser: bool = False) -> Iterator[tuple[str, str]]:
    """The address and the web page of a viewer on this machine that shows the recordings, until the block is left."""
    port, web_port = free_port(PORT), free_port(WEB_PORT)
    flags = ["--serve-web", "--bind", HOST, "--port", str(port), "--web-viewer-port", str(web_port)]
    with (
        tempfile.TemporaryDirectory(prefix="hodge-viewer-") as scratch,
        _running(flags, recordings, quiet_environment(Path(scratch))) as process,
    ):
        wait_for(port, process)
        wait_for(web_port, process)
        address = f"rerun+http://{HOST}:{port}/proxy"
        page = f"http://{HOST}:{web_port}/?url={quote(address, safe='')}"
        if opens_browser and has_screen():
            webbrowser.open(page)
        yield address, page


@contextmanager
def _running(
    flags: Sequence[str], recordings: Sequence[Path], environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    process = start([*flags, *(str(path.resolve()) for path in recordings)], environment)
    try:
        yield process
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5)
        process.kill()
        process.wait()


def start(flags: Sequence[str], environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
    """The viewer's program with these flags, out of reach of this terminal's Ctrl-C."""
    try:
        return subprocess.Popen(
            [str(program()), *flags],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        raise WorkspaceError("the program 'rerun' is not installed: pip install rerun-sdk") from error


def free_port(wished: int) -> int:
    """The port that is wished for, or any that is free."""
    with socket.socket() as probe:
        try:
            probe.bind((HOST, wished))
        except OSError:
            probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def answers(port: int) -> bool:
    """Whether a process listens on this port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((HOST, port)) == 0


def wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    """Return once the process listens on the port. Raises `WorkspaceError` where it does not."""
    deadline = time.monotonic() + START_S
    while not answers(port):
        if process.poll() is not None or time.monotonic() > deadline:
            raise WorkspaceError(
                "the Rerun viewer does not start: is there a screen? `hodge view RUN --web` needs none"
            )
        time.sleep(0.1)


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
    run_program(["analytics", "disable"], environment)
    return environment


def run_program(arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """The finished process; raises `subprocess.CalledProcessError` where it failed, `OSError` where it is missing."""
    return subprocess.run(
        [str(program()), *arguments], env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=True
    )
