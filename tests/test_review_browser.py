"""A review in a real browser: the run of docs/which-edge.md mended by mouse, by keyboard, from two tabs."""

import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.pairs.edits import read_history
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.review import scene
from hodge_pipeline.review.closeup import SLICES
from hodge_pipeline.review.looking import shown_pair
from hodge_pipeline.review.opening import Review
from hodge_pipeline.review.picking import nearest_point
from hodge_pipeline.review.settle import error_m
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.types import ViewGraph
from review_page import Page, start_browser, why_no_browser

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs"))
from make_which_edge import write_loops  # noqa: E402

pytestmark = pytest.mark.skipif(bool(why_no_browser()), reason=why_no_browser())
FRAMES, REACH, STEP_SIGMA = 60, 2, 0.003
RIGHT, MISTAKEN = ((1, 54), (3, 56), (5, 58)), ((4, 31), (5, 32), (6, 33))
"""As in docs/which-edge.md, of half as many frames."""
PLANTED = {f"{i}-{j}" for i, j in MISTAKEN}
COARSE = "--webgl-antialiasing-mode=none", "--force-device-scale-factor=0.5"
"""Nobody looks at these pages, which are drawn without a GPU."""
SMALL = (
    "outer_iterations=1", f"edges={{stage: sequential, reach: {REACH}}}", "evaluation.tables=false",
    "clouds.voxel_m=0.06", "fusion=[{stage: cloud}]", "executor.workers=0", "recording.level=off",
    "start.revisits=null", "solve_with=all",
)  # fmt: skip


@pytest.fixture(scope="module")
def spoiled_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("review")
    source = make_sequence(folder / "demo", DemoOptions(frames=FRAMES, turns=1.12, width=160, height=120))
    write_loops(folder / "loops.g2o", source, RIGHT, MISTAKEN)
    write_steps(folder / "steps.g2o", source)
    measured = ", ".join(f"{{path: {folder / name}}}" for name in ("loops.g2o", "steps.g2o"))
    hodge_pipeline.run(load_recipe("demo", [*SMALL, f"measured.files=[{measured}]"], source), folder / "run")
    return folder / "run"


def write_steps(path: Path, source: Path) -> None:
    """What registration of frames that follow each other would find, which takes most of a run's time."""
    world_from_cam = true_poses(TumReader().open(source))
    i, j = np.array([(i, i + k) for k in range(1, REACH + 1) for i in range(len(world_from_cam) - k)]).T
    noise = se3.exp(np.random.default_rng(1).normal(0, STEP_SIGMA, (len(i), 6)))
    i_from_j = se3.inverse(world_from_cam[i]) @ world_from_cam[j] @ noise
    information = np.tile(np.eye(6) / STEP_SIGMA**2, (len(i), 1, 1))
    numbers = np.arange(len(world_from_cam))
    write_g2o(path, ViewGraph.from_edges(numbers, np.stack([i, j], axis=1), i_from_j, information))


@pytest.fixture
def run_folder(spoiled_run: Path, tmp_path: Path) -> Path:
    return Path(copytree(spoiled_run, tmp_path / "room"))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    found = start_browser(1000, 800, *COARSE)
    yield found
    found.quit()


@pytest.fixture
def browser(chromium: Any) -> Iterator[Any]:
    yield chromium
    chromium.get("about:blank")  # a scene that nobody looks at any more is drawn all the same


@pytest.fixture(scope="module")
def bare() -> Iterator[Any]:
    """A browser with the first WebGL alone, which viser cannot draw with: most of the time goes into drawing scenes."""
    found = start_browser(1000, 700, "--disable-webgl2", "--disable-es3-gl-context")
    yield found
    found.quit()


def bare_page(browser: Any, address: str) -> Page:
    """The page without its scene, once it shows the first poses."""
    page = Page.__new__(Page)
    page.browser = browser
    browser.get(address)
    page.until(lambda: page.data("settled") is not None and page.data("doing") == "")
    return page


@pytest.fixture
def review(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Review]:
    monkeypatch.setattr(scene, "MOST_POINTS", 20_000)  # drawn without a GPU
    with Review(run_folder, who="ada") as opened:
        opened.session.wait()
        yield opened


def error_of(folder: Path) -> float:
    run = Run.load(folder)
    found = error_m(run.result.world_from_cam, true_poses(run.source)[run.key_frames.rows])
    assert found is not None
    return found


def test_three_wrong_edges_taken_out_by_mouse_and_the_run_solved(
    browser: Any, review: Review, run_folder: Path
) -> None:
    session, before_m = review.session, error_of(run_folder)
    page = Page(browser, review)
    assert set(page.rows()) >= PLANTED
    page.sort("gap")
    page.sort("score")
    for name in sorted(PLANTED):
        page.choose(name)
        page.decided(lambda: page.click("#disable"))
    mended_m = session.settled.error_m
    assert before_m > 0.3 and mended_m is not None and mended_m < 0.05
    page.decided(lambda: page.click("#undo"))
    assert session.settled.error_m is not None and session.settled.error_m > 0.1
    page.choose(sorted(PLANTED)[-1])
    page.find("#note").send_keys("one desk taken for the other")
    page.decided(lambda: page.click("#disable"))
    assert session.settled.error_m == pytest.approx(mended_m, rel=0.05)
    assert set(read_history(run_folder / "edits.json").disabled) == PLANTED
    assert session.decisions.lines()[-1]["note"] == "one desk taken for the other"

    page.click("#finish")
    page.until(lambda: "solved and fused" in page.text("message"))
    assert error_of(run_folder) < 0.05


def test_the_same_by_keyboard(browser: Any, review: Review, run_folder: Path) -> None:
    page = Page(browser, review)
    for _ in PLANTED:
        was = page.selected()
        page.press("j")
        page.until(lambda: page.selected() not in ("", was))  # noqa: B023
        page.decided(lambda: page.press("d"))
    page.decided(lambda: page.press("u"))
    page.decided(lambda: page.press("y"))
    assert set(read_history(run_folder / "edits.json").disabled) == PLANTED
    assert review.session.settled.error_m is not None and review.session.settled.error_m < 0.05
    page.press("2")
    page.until(lambda: review.session.look.mode == "edge")
    page.press("1")
    page.until(lambda: review.session.look.mode == "all")
    page.press("1")
    looks_at_all(page)


def test_a_line_clicked_in_the_scene_is_selected(browser: Any, review: Review) -> None:
    page, session = Page(browser, review), review.session
    graph, poses = session.table.graph, session.settled.world_from_cam
    lines = [poses[graph.edges[session.rows_of(name)[0]], :3, 3] for name in sorted(PLANTED)]
    middle = next(ends.mean(axis=0) for ends in lines if page.place(ends.mean(axis=0)) is not None)
    page.click_scene(middle)
    page.until(page.selected)
    assert page.selected() in PLANTED


def test_an_edge_added_by_three_clicked_points(browser: Any, review: Review, run_folder: Path) -> None:
    page, session = Page(browser, review), review.session
    i, j = 4, 7
    truth = true_poses(session.subject.source)
    motion = se3.inverse(truth[i]) @ truth[j]
    clouds = session.subject.clouds
    assert clouds is not None and not session.rows_of(f"{i}-{j}")
    for name in sorted(PLANTED):
        page.choose(name)
        page.decided(lambda: page.click("#disable"))
    page.browser.execute_script("document.getElementById('adding').open = true")
    page.find("#first").send_keys(str(i))
    page.find("#second").send_keys(str(j))
    page.click("#pick")
    page.until(lambda: page.find("#candidate").is_displayed())
    page.click("#apart")
    page.until(lambda: session.look.mode == "apart")
    arrived(page)
    for count, (here, there) in enumerate(matching(page, i, j, motion), start=1):
        for point, done in ((here, (count, count - 1)), (there, (count, count))):
            page.click_scene(point)
            page.until(lambda: clicks(session) == done)  # noqa: B023
    assert session.candidate is not None
    off = se3.log(se3.inverse(motion) @ session.candidate.guess)
    assert np.abs(off).max() < 0.25, off
    page.click("#register")
    page.until(lambda: session.candidate is not None and session.candidate.found is not None)
    assert session.candidate.found is not None and not session.candidate.rejected
    off = se3.log(se3.inverse(motion) @ session.candidate.found.i_from_j)
    assert np.abs(off).max() < 0.05, off
    page.decided(lambda: page.click("#accept"))
    assert session.settled.weights[session.rows_of(f"{i}-{j}")[0]] == 1
    assert read_history(run_folder / "edits.json").registered == (f"{i}-{j}",)


def test_a_first_guess_by_the_handles_of_the_second_cloud(browser: Any, review: Review) -> None:
    page, session = Page(browser, review), review.session
    page.browser.execute_script("document.getElementById('adding').open = true")
    page.find("#first").send_keys("4")
    page.find("#second").send_keys("7")
    page.click("#pick")
    page.until(lambda: page.find("#candidate").is_displayed())
    before = session.candidate.guess  # type: ignore[union-attr]
    page.click("#put")
    page.until(lambda: session.look.mode == "place")
    arrived(page)
    handle = page.until(lambda: page.handle("/pair/second"))
    ways = np.outer([0.5, 0.6, 0.7, 0.9], [handle.scale, 0, 0])  # along the arrow of x
    pose = se3.from_quat_xyzw(np.array(handle.position), np.array(handle.wxyz)[[1, 2, 3, 0]])
    time.sleep(2)  # the handles are drawn a few frames after the server has made them
    arrow = se3.transform(pose, ways)
    page.click_scene(*arrow)
    page.until(lambda: "the place it was put at" in page.text("found"))
    moved = se3.log(se3.inverse(before) @ session.candidate.guess)  # type: ignore[union-attr]
    assert moved[3] == pytest.approx(ways[-1, 0] - ways[0, 0], rel=0.2) and np.abs(np.delete(moved, 3)).max() < 1e-6


def test_a_page_that_comes_later_looks_at_the_same_pair(browser: Any, review: Review) -> None:
    page, session = Page(browser, review), review.session
    page.choose(sorted(PLANTED)[0])
    session.show(mode="edge")
    arrived(page)
    browser.get("about:blank")
    page.until(lambda: page.scene is None)
    begins = page.review.viewer.server.initial_camera.look_at
    assert np.allclose(begins, shown_pair(session, False).middle)  # type: ignore[union-attr]
    later = Page(browser, review)
    arrived(later)
    session.show(mode="all")
    looks_at_all(later)


def test_the_second_cloud_fades_from_the_edges_place_to_the_solutions(browser: Any, review: Review) -> None:
    page, session = Page(browser, review), review.session
    page.choose(sorted(PLANTED)[0])
    sent = []
    for mode, share in (("edge", 0), ("between", 3), ("solution", SLICES)):
        session.show(mode=mode, share=0.3)
        page.until(lambda: [len(seen(page, name)) for name in ("second", "solved")] == [SLICES - share, share])  # noqa: B023
        sent.append(page.handle("/pair/second/9"))
    assert sent[0] is sent[1] is sent[2]


def seen(page: Page, name: str) -> list[Any]:
    """The parts of a cloud that are shown."""
    parts = [page.handle(f"/pair/{name}/{number}") for number in range(SLICES)]
    return [part for part in parts if part is not None and part.visible]


def clicks(session: Any) -> tuple[int, int]:
    candidate = session.candidate
    return len(candidate.points_i), len(candidate.points_j)


def arrived(page: Page) -> None:
    """Return when the page looks at the pair that is shown."""
    middle = shown_pair(page.review.session, False).middle  # type: ignore[union-attr]
    page.until(lambda: np.allclose(page.scene.camera.look_at, middle, atol=1e-3))
    time.sleep(0.5)  # the position follows in a message of its own


def looks_at_all(page: Page) -> None:
    """Return when the page looks at the whole scene."""
    _, middle = page.review.scene.overview(page.review.session.settled.world_from_cam)
    page.until(lambda: np.allclose(page.scene.camera.look_at, middle, atol=1e-3))


def matching(page: Page, i: int, j: int, i_from_j: Any) -> list[tuple[Any, Any]]:
    """Three places far from each other, in the world, that both clouds have and that a click at them picks."""
    from scipy.spatial import cKDTree

    pair, clouds = shown_pair(page.review.session, False), page.review.session.subject.clouds
    assert pair is not None and clouds is not None
    first, second = (np.asarray(clouds[row].points_in_cam, float) for row in (i, j))
    distance, at = cKDTree(se3.transform(i_from_j, second)).query(first)
    shown = se3.transform(pair.world_from_i, first), se3.transform(pair.world_from_j, second)
    eye, frame = np.asarray(page.scene.camera.position), page.find("#scene").rect

    def picked(points: Any, row: int) -> bool:
        if page.place(points[row], frame) is None or nearest_point(eye, points[row] - eye, points) != row:
            return False
        away = points[row] - eye
        beside = [away + sign * np.cross(away, axis) * 1e-3 for sign in (-1, 1) for axis in np.eye(3)]  # a pixel off
        found = [nearest_point(eye, ray, points) for ray in beside]
        return all(one is not None and np.linalg.norm(points[one] - points[row]) < 0.1 for one in found)

    near = np.flatnonzero(distance < 0.04)
    seen = np.array([row for row in near[::12] if picked(shown[0], row) and picked(shown[1], at[row])])
    ways = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0.3]])
    corners = [int(seen[np.argmin(first[seen] @ way)]) for way in ways]
    return [(shown[0][row], shown[1][at[row]]) for row in corners]


def test_two_tabs_and_a_stale_decision(bare: Any, review: Review, run_folder: Path) -> None:
    page, first = bare_page(bare, review.address), bare.current_window_handle
    stale, fresh, _ = sorted(PLANTED)
    page.choose(stale)
    bare.execute_script("events.close()")  # this tab hears of nothing any more
    bare.switch_to.new_window("tab")
    other = bare_page(bare, review.address)
    other.choose(fresh)
    other.click("#disable")
    other.until(lambda: other.data("revision") == "1")
    bare.close()
    bare.switch_to.window(first)
    page.click("#disable")
    page.until(lambda: "another page has decided" in page.text("message"))
    assert read_history(run_folder / "edits.json").disabled == (fresh,)


def test_a_server_that_is_killed_loses_no_decision(bare: Any, run_folder: Path) -> None:
    name = sorted(PLANTED)[0]
    serve = [sys.executable, "-m", "hodge_pipeline.cli.main", "review", str(run_folder), "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    for start in (1, 2):
        process = subprocess.Popen(serve, stdout=subprocess.PIPE, text=True, env=environment)
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            page = bare_page(bare, address)
            if start == 1:
                page.choose(name)
                page.click("#disable")
                page.until(lambda: page.data("revision") == "1")  # noqa: B023
            else:
                page.until(lambda: "1 disabled" in page.text("facts"))  # noqa: B023
                with pytest.raises(urllib.error.HTTPError, match="403"):
                    urllib.request.urlopen(address.rsplit("/", 2)[0] + "/guessed/")
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
    assert read_history(run_folder / "edits.json").disabled == (name,)


def test_without_webgl_there_is_a_line_and_every_decision(bare: Any, review: Review, run_folder: Path) -> None:
    page = bare_page(bare, review.address)
    script = "return ['main', 'aside'].map(name => document.querySelector(name).getBoundingClientRect().width)"
    assert min(bare.execute_script(script)) > 950, "in a small window one is above the other"
    assert "has no WebGL 2" in page.find("#no-webgl").text and not bare.find_elements("css selector", "#scene")
    page.choose(sorted(PLANTED)[0])
    page.press("d")
    page.until(lambda: page.data("revision") == "1")
    assert read_history(run_folder / "edits.json").disabled == (sorted(PLANTED)[0],)


def test_another_origin_gets_no_socket(browser: Any, review: Review) -> None:
    """A page of a stranger's, opened in the same browser, that even knows the token."""
    browser.get("data:text/html,<p>a stranger's page</p>")
    script = """
        const [address, done] = arguments;
        const socket = new WebSocket(address.replace('http', 'ws') + 'scene', 'viser-v1.1.1');
        socket.onopen = () => done('open'); socket.onerror = () => done('refused');
    """
    assert browser.execute_async_script(script, review.address) == "refused"
    fetched = "const [a, done] = arguments; fetch(a + 'state').then(() => done('read'), () => done('refused'))"
    assert browser.execute_async_script(fetched, review.address) == "refused"
    assert review.viewer is not None and not review.viewer.server.get_clients()
