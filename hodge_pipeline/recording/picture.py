"""A picture of a recording, as the viewer draws it, without a window: needs Vulkan, if only Mesa's lavapipe."""

from __future__ import annotations

import socket
import subprocess
import tempfile
import time
from pathlib import Path

from rerun.experimental import ViewerClient

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import binary, layout

HOST = "127.0.0.1"
START_S = 30.0
ATTEMPTS = 5
WINDOW = "1600x900"


def picture(recording: Path, png: Path, *, story_s: float | None = None, wait_s: float = 3.0) -> None:
    """A PNG of the recording as it opens, or at `story_s` seconds of the story.

    `wait_s` is how long the viewer may load before the picture. Raises `WorkspaceError` where no viewer starts.
    """
    with tempfile.TemporaryDirectory(prefix="hodge-picture-") as scratch:
        port = _free_port()
        options = ["--headless", "--bind", HOST, "--port", str(port), "--window-size", WINDOW]
        environment, nowhere = binary.quiet_environment(Path(scratch)), subprocess.DEVNULL
        command = [str(binary.program()), *options]
        with subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere) as viewer:
            try:
                client = _connect(port, viewer)
                client.open(str(recording.resolve()))
                time.sleep(wait_s)
                if story_s is not None:
                    client.set_time(layout.STORY, duration=story_s, play_state="paused")
                    time.sleep(wait_s / 2)
                _save(client, png)
            finally:
                viewer.kill()


def _save(client: ViewerClient, png: Path) -> None:
    """Draw it, as often as a machine without a GPU, and busy, runs out of the viewer's own patience."""
    for attempt in range(ATTEMPTS):
        try:
            client.save_screenshot(str(png.resolve()))
        except TimeoutError as error:
            if attempt + 1 == ATTEMPTS:
                raise WorkspaceError("the headless Rerun viewer is too slow here for a picture: try again") from error
        else:
            return


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _connect(port: int, viewer: subprocess.Popen[bytes]) -> ViewerClient:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and viewer.poll() is None:
        try:
            return ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
        except (RuntimeError, ConnectionError, ValueError):
            time.sleep(0.2)
    raise WorkspaceError("no headless Rerun viewer starts here: install a Vulkan driver (mesa-vulkan-drivers)")
