"""Takes the gallery's pictures out of the report of a finished demo: `python docs/make_gallery.py runs/demo`."""

from __future__ import annotations

import base64
import io
import re
import sys
from pathlib import Path

from PIL import Image

PICTURES = Path(__file__).parent / "pictures"
WIDTH = 900
TAKEN = {
    "errors": "Error over time, per axis",
    "coloured": "Error along the path",
    "edges": "Viewing graph",
    "room": "From the front",
    "detail": "Part of what frame",
}
"""The name of a picture here, and what its caption has."""


def main() -> None:
    """Write `gallery-*.jpg`, at most 900 pixels wide, on white."""
    page = (Path(sys.argv[1]) / "report.html").read_text("utf-8")
    found = re.findall(r'<img[^>]*alt="([^"]*)"[^>]*base64,([^"]+)"', page)
    for name, caption in TAKEN.items():
        contents = next(contents for alt, contents in found if caption in alt)
        with Image.open(io.BytesIO(base64.b64decode(contents))) as picture:
            picture.thumbnail((WIDTH, WIDTH))
            white = Image.new("RGB", picture.size, "white")
            white.paste(picture.convert("RGBA"), mask=picture.convert("RGBA").getchannel("A"))
            white.save(PICTURES / f"gallery-{name}.jpg", quality=80, optimize=True)


if __name__ == "__main__":
    main()
