"""Takes the pictures of docs/review.md in a headless Chromium.

`python docs/make_review.py room runs/room` walks through the run of docs/which-edge.md;
`python docs/make_review.py look PATH NAME` opens a run, graph or model, looks at the worst edge from near and disables
all that is wrong. What is reviewed is copied, and stays as it is.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "tests"))

from make_which_edge import MISTAKEN  # noqa: E402

from hodge_pipeline import se3  # noqa: E402
from hodge_pipeline.review.looking import shown_pair  # noqa: E402
from hodge_pipeline.review.opening import Review  # noqa: E402
from review_page import Page, start_browser  # noqa: E402

PICTURES = HERE / "pictures"
WIDTH = 1100
JOINED = 4, 8


def picture(page: Page, name: str) -> None:
    """A screenshot as a JPEG of the docs."""
    with tempfile.TemporaryDirectory() as folder:
        page.picture(Path(folder) / "shot.png")
        image = Image.open(Path(folder) / "shot.png").convert("RGB")
        image.resize((WIDTH, round(image.height * WIDTH / image.width))).save(PICTURES / name, quality=80)


def walk(browser: Any, room: Path) -> None:
    """Every step of the page, a picture of each, and how long a decision takes."""
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
            began, cpu = time.perf_counter(), time.process_time()
            page.decided(lambda: page.press("d"))
            spent = f"{time.process_time() - cpu:.2f} CPU s, {time.perf_counter() - began:.2f} s in all"
            print(name, page.text("facts"), page.text("latency"), spent)
            page.press("1")
            if name == names[0]:
                picture(page, "review-first.jpg")
        picture(page, "review-mended.jpg")
        join(page)
        page.decided(lambda: page.press("u"))
        page.decided(lambda: page.press("y"))
        page.press("s")
        page.until(lambda: "solved and fused" in page.text("message"))
        picture(page, "review-solved.jpg")


def join(page: Page) -> None:
    """Three points clicked in each of two clouds, and the handles of the second."""
    from test_review_browser import matching

    session, (i, j) = page.review.session, JOINED
    page.browser.execute_script("document.getElementById('adding').open = true")
    page.find("#first").send_keys(str(i))
    page.find("#second").send_keys(str(j))
    page.click("#pick")
    page.until(lambda: page.find("#candidate").is_displayed())
    page.click("#apart")
    page.until(lambda: session.look.mode == "apart")
    page.until(lambda: page.place(shown_pair(session, False).middle))  # type: ignore[union-attr]
    truth = session.subject.truth
    for count, points in enumerate(matching(page, i, j, se3.inverse(truth[i]) @ truth[j]), start=1):
        for point, clicked in zip(points, (2 * count - 1, 2 * count), strict=True):
            page.click_scene(point)
            page.until(lambda: len(session.candidate.points_i + session.candidate.points_j) == clicked)  # noqa: B023
    picture(page, "review-points.jpg")
    page.click("#put")
    picture(page, "review-handles.jpg")
    page.press("1")


def look(browser: Any, path: Path, name: str) -> None:
    """What is wrong at first, all that off, and the worst edge from near."""
    with Review(path, who="ada") as review:
        page = Page(browser, review)
        dismiss(page)
        print(page.text("name"), page.text("facts"))
        picture(page, f"review-{name}.jpg")
        if (rows := page.rows()) and review.session.subject.clouds is not None:
            page.choose(rows[0])
            page.press("2")
            page.until(lambda: page.browser.execute_script("return document.querySelector('#pictures img') !== null"))
            page.browser.execute_script("document.getElementById('edge').scrollIntoView()")
            picture(page, f"review-{name}-edge.jpg")
            page.press("1")
        if rows:
            page.decided(lambda: page.press("w"))
            page.press("1")
            page.browser.execute_script("document.getElementById('name').scrollIntoView()")
            print(page.text("facts"), page.text("latency"))
            picture(page, f"review-{name}-mended.jpg")


def dismiss(page: Page) -> None:
    """Close viser's message that there is no GPU."""
    page.browser.switch_to.frame(page.find("#scene"))
    for button in page.browser.find_elements("css selector", ".mantine-Notification-closeButton"):
        button.click()
    page.browser.switch_to.default_content()


def main(what: str, given: Path, *name: str) -> None:
    """The pictures of one part."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / given.name
        shutil.copytree(given, copy) if given.is_dir() else shutil.copy(given, copy)
        browser = start_browser(1600, 1000)
        walk(browser, copy) if what == "room" else look(browser, copy, *name)
        browser.quit()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
