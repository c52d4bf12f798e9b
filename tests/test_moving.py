"""Objects that move before the camera: the poses stay those of the camera, and the report names the frames."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.tracking import tracker
from hodge_pipeline.registration.tracking.flow import find_corners, flow_image, follow
from hodge_pipeline.registration.tracking.frame import TrackedFrame
from hodge_pipeline.registration.tracking.moving import MUCH, Moments, contradicting, misplaced, rival_motion
from hodge_pipeline.registration.tracking.sightings import Sightings
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.key_frames import KeyFrameStart, Tracked, _puts_in_doubt, track
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Frame, Source
from hodge_pipeline.types.notes import Note

WIDTH, HEIGHT, FRAMES = 320, 240, 16
RANGE_M = (0.2, 8.0)


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Source:
    options = DemoOptions(frames=FRAMES, width=WIDTH, height=HEIGHT, stride=1, turns=0.04)
    return TumReader().open(make_sequence(tmp_path_factory.mktemp("moving") / "sequence", options))


def with_block(source: Source, share: float, distance_m: float = 0.8, step_px: int = 3) -> Source:
    """A textured board of this share of the image before the camera, `step_px` further to the right in each frame."""
    side = int(np.sqrt(share * WIDTH * HEIGHT))
    coarse = np.random.default_rng(7).integers(0, 255, (side // 5 + 1, side // 5 + 1, 3), dtype=np.uint8)
    board = np.kron(coarse, np.ones((5, 5, 1), np.uint8))[:side, :side]

    def pasted(read: Callable[[], Any], value: Any, left: int) -> Callable[[], Any]:
        def show() -> Any:
            image = np.array(read())
            image[20 : 20 + side, left : left + side] = value
            return image

        return show

    def changed(place: int, frame: Frame) -> Frame:
        assert frame.read_colour is not None and frame.read_depth is not None
        left = 20 + step_px * place
        return replace(
            frame,
            read_colour=pasted(frame.read_colour, board, left),
            read_depth=pasted(frame.read_depth, np.float32(distance_m), left),
        )

    return replace(source, frames=tuple(changed(place, frame) for place, frame in enumerate(source.frames)))


def tracked(source: Source, folder: Path) -> tuple[Tracked, list[Note]]:
    recipe, notes = load_recipe("demo", ["start.whole_up_to=5"], source.path), list[Note]()
    assert isinstance(recipe.start, KeyFrameStart)
    folder.mkdir()
    step = Step(folder, no_progress, lambda *told: notes.extend(told))
    with pytest.MonkeyPatch.context() as patch:  # a third of the cost, of which nothing here tells
        patch.setattr("hodge_pipeline.start.key_frames.estimate_readout", lambda *_: None)
        return track(source, recipe.start._tracking(recipe.clouds), workers=InProcess(), step=step), notes


def largest_error_m(source: Source, found: Tracked) -> float:
    """Of the frames' positions in the axes of the first, each by tracking and by the truth."""
    poses = found.world_from_key[found.anchors] @ found.key_from_frame
    true = np.array([frame.true_world_from_cam for frame in source.frames])
    by_tracking, by_truth = se3.inverse(poses[0]) @ poses, se3.inverse(true[0]) @ true
    return float(np.linalg.norm(by_tracking[:, :3, 3] - by_truth[:, :3, 3], axis=1).max())


@pytest.mark.parametrize(("share", "distance_m"), [(0.2, 0.5), (0.2, 1.2)])
def test_the_camera_is_tracked_past_a_moving_object(
    still: Source, tmp_path: Path, share: float, distance_m: float
) -> None:
    source = with_block(still, share, distance_m)
    found, notes = tracked(source, tmp_path / "block")
    assert largest_error_m(source, found) < 0.08
    (note,) = [note for note in notes if note.kind == "moving objects"]
    assert note.count > FRAMES / 2


def test_nothing_moves_in_a_still_scene(still: Source, tmp_path: Path) -> None:
    for name, source in (("still", still), ("bare", bare(still))):
        found, notes = tracked(source, tmp_path / name)
        assert not {"moving objects", "camera or object"} & {note.kind for note in notes}
        assert largest_error_m(still, found) < 0.03


def test_depth_and_colour_of_different_moments_are_no_object_before_a_camera_that_turns(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    options = DemoOptions(frames=14, width=WIDTH, height=HEIGHT, stride=1, turns=0.05)
    swept = TumReader().open(make_sequence(tmp_path_factory.mktemp("swept") / "sequence", options))
    poses = [frame.true_world_from_cam for frame in swept.frames]

    def shares(source: Source, told: Callable[..., float] = contradicting, other: int = 6) -> tuple[float, float]:
        """Against the true motion, by itself and with the twists; colour is a place, a 60th of a second, late."""
        frames = [replace(source.frames[row], read_colour=source.frames[row + 1].read_colour) for row in (2, other)]
        key, view = (flow_image(frame, RANGE_M) for frame in frames)
        assert key is not None and view is not None
        twists = [60 * se3.log(se3.inverse(poses[row]) @ poses[row + 1]) for row in (2, other)]
        motion = se3.inverse(poses[3]) @ poses[other + 1]
        return told(key, view, motion), told(key, view, motion, Moments(twists[0], twists[1]))

    by_itself, with_twists = shares(swept)
    assert by_itself > tracker.DOUBTFUL and with_twists < 0.05
    assert shares(with_block(swept, 0.4))[1] > tracker.DOUBTFUL
    by_itself, with_twists = shares(swept, misplaced, 4)
    assert by_itself > tracker.MISPLACED and with_twists < MUCH


def test_stamps_that_err_take_no_frame_from_the_flow(tmp_path: Path) -> None:
    options = DemoOptions(frames=10, width=WIDTH, height=HEIGHT, stride=1, turns=0.036)
    swept = TumReader().open(make_sequence(tmp_path / "sequence", options))

    def followed(delay_s: float) -> set[int]:
        frames = tuple(replace(frame, colour_delay_s=delay_s) for frame in swept.frames)
        found, _ = tracked(replace(swept, frames=frames), tmp_path / f"{delay_s}")
        return {int(row) for path in found.sightings.glob("*.npz") for row in artifacts.load(path, Sightings).frame}

    assert followed(0.03) == followed(0.0) >= {3, 5, 6, 7, 8, 9}


def bare(source: Source) -> Source:
    """The source almost without texture: corners are where the board is."""

    def plain(read: Callable[[], Any]) -> Any:
        return (np.array(read()) // 16 + 110).astype(np.uint8)

    frames = tuple(
        replace(frame, read_colour=None if frame.read_colour is None else partial(plain, frame.read_colour))
        for frame in source.frames
    )
    return replace(source, frames=frames)


@pytest.mark.parametrize(("share", "step_px"), [(0.05, 2), (0.1, 2), (0.1, -1)])
def test_in_a_bare_room_surfaces_tell_the_motion_where_corners_lie_on_what_moves(
    still: Source, tmp_path: Path, share: float, step_px: int
) -> None:
    source = with_block(bare(still), share, step_px=step_px)
    found, _ = tracked(source, tmp_path / "bare")
    assert largest_error_m(source, found) < 0.06, "by the corners 0.09, and by them alone 0.27"


@pytest.mark.parametrize("texture", [True, False])
def test_an_object_that_may_have_been_followed_puts_the_path_in_doubt(
    still: Source, tmp_path: Path, texture: bool
) -> None:
    source = with_block(still if texture else bare(still), 0.4, step_px=2)
    _, notes = tracked(source, tmp_path / "large")
    (note,) = [note for note in notes if note.kind == "camera or object"]
    assert note.count > FRAMES / 4


def test_a_few_doubtful_frames_of_a_short_sequence_are_chance() -> None:
    assert [_puts_in_doubt(count, 12) for count in (2, 3, 4)] == [False, False, True]
    assert [_puts_in_doubt(count, 60) for count in (9, 11)] == [False, True]
    assert [_puts_in_doubt(count, 1000) for count in (100, 101)] == [False, True]


def test_the_vote_is_by_area_whichever_motion_is_found_first(still: Source) -> None:
    first, later = (flow_image(frame, RANGE_M) for frame in with_block(still, 0.2).frames[::4][:2])
    assert first is not None and later is not None
    corners = find_corners(first)
    by_board = follow(corners, later, np.eye(4))
    assert by_board is not None
    against, rival = rival_motion(corners, later, by_board, np.eye(4))
    assert rival is not None and rival.fits_better and against > 0.5
    assert against == contradicting(first, later, by_board.key_from_view)
    assert misplaced(first, later, by_board.key_from_view) > 0.5
    board = np.zeros((HEIGHT, WIDTH), bool)
    side = int(np.sqrt(0.2 * WIDTH * HEIGHT))
    board[20 : 20 + side, 20 : 20 + side] = True
    assert rival.moving[board].mean() > 0.7
    assert rival.moving[~board].mean() < 0.2
    _, back = rival_motion(rival.corners, later, rival.followed, np.eye(4))
    assert back is not None and not back.fits_better


def test_what_was_left_out_of_a_key_frame_is_not_misplaced(still: Source) -> None:
    source = with_block(still, 0.2)
    recipe = load_recipe("demo", [], source.path)
    assert isinstance(recipe.start, KeyFrameStart)
    options = recipe.start._tracking(recipe.clouds)
    key, view = (
        TrackedFrame(source.frames[place], place, options.clouds, options.odometry.registration) for place in (0, 4)
    )
    side, board = int(np.sqrt(0.2 * WIDTH * HEIGHT)), np.zeros((HEIGHT, WIDTH), np.uint8)
    board[20 : 20 + side, 20 : 20 + side] = 1
    assert key.image is not None and view.image is not None
    whole, corners = key.image, find_corners(key.image, 1 - board)
    key.leave_out(board, corners)
    found = follow(corners, view.image, np.eye(4))
    assert found is not None
    with_board = misplaced(whole, view.image, found.key_from_view)
    assert 0.1 < misplaced(key.image, view.image, found.key_from_view) < 0.7 * with_board
