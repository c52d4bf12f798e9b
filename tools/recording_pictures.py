"""Draws each tab of a recording, without a window: `python tools/recording_pictures.py runs/demo docs/pictures`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from hodge_pipeline.recording.merge import find_parts, merge_parts
from hodge_pipeline.recording.picture import picture
from hodge_pipeline.recording.recorder import APPLICATION

TABS = ("story", "frames", "registration", "complex", "solver", "model", "evaluation", "log")
WIDTH = 1000
COLOURS = 128


def draw(run: Path, out: Path, tabs: tuple[str, ...]) -> None:
    """Write `recording-<tab>.png` for these tabs of a run whose stages were all recorded."""
    parts = [part for folder in sorted((run / "stages").glob("record*")) for part in find_parts(folder)]
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for tab in tabs:
            recording, png = Path(scratch) / f"{tab}.rrd", out / f"recording-{tab}.png"
            merge_parts(parts, recording, APPLICATION, f"picture-{tab}", active_tab=TABS.index(tab))
            picture(recording, png, wait_s=8.0)
            with Image.open(png) as image:
                height = round(image.height * WIDTH / image.width)
                image.convert("RGB").resize((WIDTH, height)).quantize(COLOURS).save(png, optimize=True)
            print(f"{png}: written")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python tools/recording_pictures.py RUN OUT [TAB …]")
    draw(Path(sys.argv[1]), Path(sys.argv[2]), tuple(sys.argv[3:]) or TABS)
