"""Draws each tab of a recording, without a window: `python tools/recording_pictures.py runs/demo docs/pictures`.

It needs Vulkan, if only Mesa's lavapipe: `apt-get install mesa-vulkan-drivers libvulkan1`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from rerun.experimental import ViewerClient

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import layout, live
from hodge_pipeline.recording.live import HOST, free_port
from hodge_pipeline.recording.merge import find_parts, merge

TABS = {
    "story": "Story", "frames": "Frames", "registration": "Registration", "complex": "Complex, diagnosis",
    "solver": "Edges and solver", "model": "Model", "evaluation": "Evaluation", "log": "Log and recipe",
}  # fmt: skip
WIDTH = 1000
COLOURS = 128
START_S = 30.0
ATTEMPTS = 5
WINDOW = "1600x900"


def draw(run: Path, out: Path, tabs: tuple[str, ...]) -> None:
    """Write `recording-<tab>.png` for these tabs of a run that has what they show."""
    parts = [part for folder in sorted((run / "stages").glob("record*")) for part in find_parts(folder)]
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for tab in tabs:
            recording, png = Path(scratch) / f"{tab}.rrd", out / f"recording-{tab}.png"
            merge(parts, recording, f"picture-{tab}", TABS[tab])
            picture(recording, png, wait_s=8.0)
            with Image.open(png) as image:
                height = round(image.height * WIDTH / image.width)
                image.convert("RGB").resize((WIDTH, height)).quantize(COLOURS).save(png, optimize=True)
            print(f"{png}: written")


def picture(recording: Path, png: Path, *, story_s: float | None = None, wait_s: float = 3.0) -> None:
    """A PNG of the recording as it opens, or at `story_s` seconds of the story.

    `wait_s` is how long the viewer may load before the picture. Raises `WorkspaceError` where no viewer starts.
    """
    with tempfile.TemporaryDirectory(prefix="hodge-picture-") as scratch:
        port = free_port(0)
        options = ["--headless", "--bind", HOST, "--port", str(port), "--window-size", WINDOW]
        environment, nowhere = live.quiet_environment(Path(scratch)), subprocess.DEVNULL
        command = [str(live.program()), *options]
        with subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere) as viewer:
            try:
                client = _connect(port, viewer)
                client.open(str(recording.resolve()))
                time.sleep(wait_s)
                if story_s is not None:
                    client.set_time(layout.STORY, duration=story_s, play_state="paused")
                    time.sleep(wait_s / 2)
                _save(client, png)
            except ConnectionError as error:
                raise WorkspaceError(f"the headless Rerun viewer ended ({error}): is there a Vulkan driver?") from error
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


def _connect(port: int, viewer: subprocess.Popen[bytes]) -> ViewerClient:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and viewer.poll() is None:
        try:
            return ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
        except (RuntimeError, ConnectionError, ValueError):
            time.sleep(0.2)
    raise WorkspaceError("no headless Rerun viewer starts here: install a Vulkan driver (mesa-vulkan-drivers)")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python tools/recording_pictures.py RUN OUT [TAB …]")
    draw(Path(sys.argv[1]), Path(sys.argv[2]), tuple(sys.argv[3:]) or tuple(TABS))
