"""Walks through docs/review.md in a headless Chromium and takes its pictures: `python docs/make_review.py runs/room`.

The run is the one of docs/which-edge.md; it is copied, and stays as it is.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "tests"))

from make_which_edge import MISTAKEN  # noqa: E402

from hodge_pipeline.review.opening import Review  # noqa: E402
from review_page import Page, start_browser  # noqa: E402

PICTURES = HERE / "pictures"
WIDTH = 1100


def picture(page: Page, name: str) -> None:
    """A screenshot as a JPEG of the docs."""
    with tempfile.TemporaryDirectory() as folder:
        page.picture(Path(folder) / "shot.png")
        image = Image.open(Path(folder) / "shot.png").convert("RGB")
        image.resize((WIDTH, round(image.height * WIDTH / image.width))).save(PICTURES / name, quality=80)


def main(run: Path) -> None:
    """Every step of the page, a picture of each, and how long a decision takes."""
    with tempfile.TemporaryDirectory() as folder:
        room = Path(shutil.copytree(run, Path(folder) / "room"))
        browser = start_browser(1600, 1000)
        with Review(room, who="ada") as review:
            page = Page(browser, review)
            dismiss(page)
            picture(page, "review-start.jpg")
            names = [f"{i}-{j}" for i, j in MISTAKEN]
            page.choose(names[0])
            page.press("2")
            picture(page, "review-edge.jpg")
            page.press("1")
            for name in names:
                page.choose(name)
                began = time.perf_counter()
                page.decided(lambda: page.press("d"))
                print(name, page.text("facts"), page.text("latency"), f"{time.perf_counter() - began:.2f} s in all")
                page.press("1")
                if name == names[0]:
                    picture(page, "review-first.jpg")
            picture(page, "review-mended.jpg")
            page.decided(lambda: page.press("u"))
            page.decided(lambda: page.press("y"))
            page.press("s")
            page.until(lambda: "solved and fused" in page.text("message"))
            picture(page, "review-solved.jpg")
        browser.quit()


def dismiss(page: Page) -> None:
    """Close viser's message that there is no GPU."""
    page.browser.switch_to.frame(page.find("#scene"))
    for button in page.browser.find_elements("css selector", ".mantine-Notification-closeButton"):
        button.click()
    page.browser.switch_to.default_content()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
