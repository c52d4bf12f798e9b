"""The page of a review in a headless Chromium, driven as a person would: for the tests and for docs/make_review.py."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline.review.opening import Review
from hodge_pipeline.types import Floats

PATIENCE_S = 120.0
"""A page drawn without a GPU beside other work takes seconds; one that never comes is a failure."""
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-background-networking",
)  # fmt: skip


def why_no_browser() -> str:
    """Why no browser can be driven here; empty where one can."""
    try:
        import selenium  # noqa: F401
        import viser  # noqa: F401
    except ImportError as error:
        return f"{error.name} is not installed: pip install -e '.[dev]'"
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"no {' and no '.join(missing)} here: apt-get install chromium chromium-driver" if missing else ""


def start_browser(width: int = 1500, height: int = 1000, *flags: str) -> Any:
    """A headless Chromium. Selenium looks nothing up: browser and driver are the ones that are installed."""
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (*FLAGS, *flags, f"--window-size={width},{height}"):
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=Service(str(shutil.which("chromedriver"))))
    browser.set_script_timeout(PATIENCE_S)
    return browser


class Page:
    """One tab with a review."""

    def __init__(self, browser: Any, review: Review) -> None:
        self.browser, self.review = browser, review
        browser.get(review.address)
        self.until(lambda: self.data("settled") is not None)
        self.until(lambda: self.scene is not None)
        self.settled()

    def until(self, is_so: Callable[[], Any]) -> Any:
        """What `is_so` gives as soon as that is something."""
        end = time.monotonic() + PATIENCE_S
        while not (found := is_so()):
            assert time.monotonic() < end, f"waited {PATIENCE_S:.0f} s; the page says: {self.text('message')}"
            time.sleep(0.05)
        return found

    @property
    def scene(self) -> Any:
        """viser's handle of this tab; None until its scene has begun."""
        clients = self.review.viewer.server.get_clients() if self.review.viewer else {}
        return clients[max(clients)] if clients else None

    def handle(self, name: str) -> Any:
        """What viser shows under a name; None while there is nothing."""
        return self.review.viewer.server.scene.get_handle_by_name(name) if self.review.viewer else None

    def data(self, name: str) -> str | None:
        return self.browser.execute_script(f"return document.body.dataset.{name} ?? null")

    def settled(self) -> None:
        """Return when the page shows the poses and the verdicts of the latest decision."""
        self.review.session.wait()
        latest = str(self.review.session.decisions.revision)
        self.until(lambda: (self.data("doing"), self.data("revision"), self.data("settled")) == ("", latest, latest))

    def find(self, selector: str) -> Any:
        return self.browser.find_element("css selector", selector)

    def text(self, name: str) -> str:
        return self.browser.execute_script(f"return document.getElementById('{name}').textContent")

    def click(self, selector: str) -> None:
        """Click an element, scrolled into view."""
        element = self.until(lambda: self.find(selector) if self.find(selector).is_enabled() else None)
        self.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        element.click()

    def press(self, keys: str) -> None:
        self.find("body").send_keys(keys)

    def rows(self) -> list[str]:
        """The names of the edges in the table."""
        script = "return [...document.querySelectorAll('#table tbody tr')].map(row => row.dataset.name)"
        return list(self.browser.execute_script(script))

    def selected(self) -> str:
        script = "return document.querySelector('#table tr.selected')?.dataset.name ?? ''"
        return str(self.browser.execute_script(script))

    def sort(self, by: str) -> None:
        """Click a heading of the table, and wait until it is sorted by it."""
        self.click(f"th[data-sort={by}]")
        self.until(lambda: "sorted" in self.find(f"th[data-sort={by}]").get_attribute("class"))

    def choose(self, name: str) -> None:
        """Click the row of an edge, once the table shows the latest state, and wait until it is selected."""
        self.until(lambda: self.data("listed") == self.data("version"))
        self.click(f"#table tr[data-name='{name}']")
        self.until(lambda: self.selected() == name)

    def decided(self, act: Callable[[], None]) -> None:
        """Do what changes the decisions, and wait for what follows."""
        before = self.review.session.decisions.revision
        act()
        self.until(lambda: self.review.session.decisions.revision > before)
        self.settled()

    def place(self, point: Floats, frame: dict[str, float] | None = None) -> tuple[float, float] | None:
        """Where a point of the world is seen, in pixels of the window; None where it is not. `frame`: the scene's."""
        camera, frame = self.scene.camera, frame or self.find("#scene").rect
        forward = np.asarray(camera.look_at) - np.asarray(camera.position)
        forward /= np.linalg.norm(forward)
        across = np.cross(forward, np.asarray(camera.up_direction))
        across /= np.linalg.norm(across)
        away = np.asarray(point) - np.asarray(camera.position)
        depth = away @ forward
        scale = frame["height"] / 2 / np.tan(camera.fov / 2)
        x = frame["x"] + frame["width"] / 2 + scale * (away @ across) / depth
        y = frame["y"] + frame["height"] / 2 + scale * (away @ np.cross(across, forward)) / depth * -1
        inside = frame["x"] < x < frame["x"] + frame["width"] and 60 < y < frame["height"] - 90
        return (float(x), float(y)) if depth > 0 and inside else None

    def click_scene(self, *points: Floats) -> None:
        """Click where a point of the world is seen; of several press at the first, and drag along the others."""
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        places = [self.place(point) for point in points]
        assert all(places), f"{points} are out of sight"
        pixels = [(round(place[0]), round(place[1])) for place in places if place is not None]
        actions = ActionBuilder(self.browser)
        actions.pointer_action.move_to_location(*pixels[0]).pointer_down()
        for pixel in pixels[1:]:
            actions.pointer_action.move_to_location(*pixel)
        actions.pointer_action.pointer_up()
        actions.perform()
        ActionChains(self.browser).reset_actions()

    def picture(self, path: Path) -> None:
        """A screenshot, once the scene had time to be drawn."""
        from selenium.common.exceptions import TimeoutException

        time.sleep(3.0)
        for attempt in range(6):
            try:
                self.browser.save_screenshot(str(path))
                return
            except TimeoutException:  # a frame without a GPU takes seconds
                assert attempt < 5
