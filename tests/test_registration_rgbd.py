from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.registration.descriptors import match, root_sift
from hodge_pipeline.registration.landmarks import find_landmarks
from hodge_pipeline.registration.pixels import back_project, depth_sigma, project, sound_depth
from hodge_pipeline.registration.rgbd import Rgbd, guided_match
from hodge_pipeline.registration.visual import VisualMotion, fit_triples, visual_motion
from hodge_pipeline.types import Bytes, Camera, CloudSet, Floats, Floats32, Frame, Landmarks, PointCloud

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
PIXEL_RAD = 1 / 525.0
I_FROM_J = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))


def motion_of(points_i: Floats, points_j: Floats, pixel_rad: float = PIXEL_RAD) -> VisualMotion | None:
    pixels = np.full(len(points_i), pixel_rad)
    return visual_motion(points_i, points_j, (pixels, pixels), seed=0)


def landmarks_at(points: Floats32, descriptors: Bytes) -> Landmarks:
    return Landmarks(points, descriptors, np.full(len(points), PIXEL_RAD, np.float32))


def points_before(count: int, rng: np.random.Generator) -> Floats:
    return np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(1.5, 3, count)])


@given(st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6), st.integers(0, 9))
@settings(max_examples=20, deadline=None)
def test_exact_landmarks_give_the_motion(xi: list[float], seed: int):
    motion = se3.exp(np.array(xi))
    points_j = points_before(40, np.random.default_rng(seed))
    points_i = se3.transform(motion, points_j)
    found = motion_of(points_i[points_i[:, 2] > 0.3], points_j[points_i[:, 2] > 0.3])
    assert found is not None
    np.testing.assert_allclose(found.i_from_j, motion, atol=1e-6)


def test_two_thirds_of_wrong_matches_are_outvoted_and_the_error_has_the_size_that_the_information_says():
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points_j = points_before(150, rng)
        points_i = se3.transform(I_FROM_J, points_j) + rng.normal(0, 0.006, (150, 3))
        points_i[:100] = points_before(100, rng)
        found = motion_of(points_i, points_j)
        assert found is not None and 40 <= found.inliers <= 65
        error = se3.log(se3.inverse(I_FROM_J) @ found.i_from_j)
        assert np.linalg.norm(error[3:]) < 0.02
        squares.append(error @ found.information @ error / 6)
    assert 0.2 < np.mean(squares) < 5


def test_depth_errors_that_neighbours_share_hardly_bend_the_motion():
    """Pixel errors are each landmark's own; those of a depth camera are bumps that many share, so they weigh less."""
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points_j, measured = points_before(100, rng), []
        for points in (se3.transform(I_FROM_J, points_j), points_j):
            seen = project(points, CAMERA)
            bumps = 1.5 * np.sin(2 * np.pi * (seen[:, :2] / [CAMERA.width, CAMERA.height] @ rng.normal(0, 1, 2)))
            seen[:, :2] += rng.normal(0, 0.3, (100, 2))
            seen[:, 2] += depth_sigma(seen[:, 2]) * (rng.normal(0, 1, 100) + bumps)
            measured.append(back_project(seen, CAMERA))
        found = motion_of(measured[0], measured[1])
        assert found is not None
        squares.append(float(np.sum((found.i_from_j[:3, 3] - I_FROM_J[:3, 3]) ** 2)))
    assert np.sqrt(np.mean(squares)) < 0.002  # 1.7 mm; 2.3 with a pixel's sigma half as large again


def test_landmarks_that_agree_on_nothing_give_no_motion_that_counts():
    rng = np.random.default_rng(3)
    found = motion_of(points_before(100, rng), points_before(100, rng))
    assert found is None or found.inliers < Rgbd().min_inliers
    assert motion_of(points_before(7, rng), points_before(7, rng)) is None


def test_three_points_give_their_rigid_motion():
    points_j = points_before(3, np.random.default_rng(0))
    np.testing.assert_allclose(
        se3.fit_rigid(se3.transform(I_FROM_J, points_j)[None], points_j[None])[0], I_FROM_J, atol=1e-9
    )


def test_triples_give_the_motions_of_least_squares_and_those_on_a_line_none():
    rng = np.random.default_rng(1)
    points_j = points_before(3 * 50, rng).reshape(-1, 3, 3)
    points_i = se3.transform(I_FROM_J, points_j) + rng.normal(0, 0.1, points_j.shape)
    np.testing.assert_allclose(fit_triples(points_i, points_j), se3.fit_rigid(points_i, points_j), atol=1e-9)
    points_j[:20, 2], points_j[20:, 2] = 2 * points_j[:20, 1] - points_j[:20, 0], points_j[20:, 1]
    assert np.isnan(fit_triples(points_i, points_j)[:, :3]).all()


def test_matching_is_mutual_and_refuses_what_looks_like_two():
    raw = np.zeros((3, 128), np.uint8)
    raw[0, 0] = raw[1, 5] = raw[2, 9] = 200
    assert match(root_sift(raw), root_sift(raw[[2, 0, 1]]), 0.8).tolist() == [[0, 1], [1, 2], [2, 0]]
    assert match(root_sift(raw), root_sift(raw[[0, 0, 1]]), 0.8).tolist() == [[1, 2]]
    assert match(root_sift(raw), root_sift(raw[:0]), 0.8).shape == (0, 2)


def textured_frame(depth_m: float = 2.0) -> Frame:
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)
    image = np.kron(coarse, np.ones((16, 16, 1), np.uint8))
    depth = np.full((480, 640), depth_m, np.float32)
    return Frame(0, 0.0, CAMERA, read_depth=lambda: depth, read_colour=lambda: image)


def test_landmarks_lie_at_the_measured_depth_and_never_on_its_edges():
    found = find_landmarks(textured_frame(), 100, 0.2, 6.0)
    assert 20 <= len(found) <= 100 and (found.points_in_cam[:, 2] == 2.0).all()
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 1::2] = 3.0
    torn = replace(textured_frame(), read_depth=lambda: depth)
    assert len(find_landmarks(torn, 100, 0.2, 6.0)) == 0


def test_no_landmark_lies_beside_what_is_nearer():
    """It would follow the nearer one's edge; beside what is farther it follows its own."""
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 1.0
    found = find_landmarks(replace(textured_frame(), read_depth=lambda: depth), 800, 0.2, 6.0)
    column = project(found.points_in_cam.astype(float), CAMERA)[:, 0]
    far = found.points_in_cam[:, 2] == 2.0
    assert column[far].max() < 320 - 6 and column[~far].min() < 320 + 6
    assert sound_depth(depth, np.array([[316, 240], [300, 240], [324, 240]]), 0.2, 6.0)[1].tolist() == [
        False,
        True,
        True,
    ]


def test_a_faint_texture_gives_landmarks():
    frame = textured_frame()
    faint = (120 + frame.read_colour() // 12).astype(np.uint8)
    assert len(find_landmarks(replace(frame, read_colour=lambda: faint), 800, 0.2, 6.0)) > 100


@pytest.mark.parametrize("lost", ["read_colour", "read_depth", "camera"])
def test_a_frame_without_image_depth_or_camera_has_no_landmark(lost: str):
    assert len(find_landmarks(replace(textured_frame(), **{lost: None}), 100, 0.2, 6.0)) == 0


def test_back_projection_is_the_inverse_of_the_camera():
    points = back_project(np.array([[319.5, 239.5, 2.0], [319.5 + 525, 239.5, 3.0]]), CAMERA)
    np.testing.assert_allclose(points, [[0, 0, 2], [3, 0, 3]], atol=1e-6)


def frames_of(count: int) -> tuple[PointCloud, PointCloud]:
    """A plane seen twice, moved within itself by 10 cm, with `count` landmarks on it: geometry alone cannot tell."""
    rng = np.random.default_rng(1)
    plane = np.column_stack([rng.uniform(-1, 1, (3000, 2)), np.full(3000, 2.0)]).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (3000, 1))
    descriptors = rng.integers(0, 255, (count, 128), dtype=np.uint8)
    marks = plane[:count]
    shifted = marks + np.array([0.1, 0, 0], np.float32)
    return PointCloud(plane, normals, None, landmarks_at(shifted, descriptors)), PointCloud(
        plane, normals, None, landmarks_at(marks, descriptors)
    )


def test_landmarks_hold_where_a_plane_slides_and_too_few_of_them_leave_it_to_the_surfaces():
    registrar = Rgbd()
    target, source = (registrar.prepare(cloud) for cloud in frames_of(40))
    found = registrar.register(target, source, np.eye(4))
    np.testing.assert_allclose(found.i_from_j[:3, 3], [0.1, 0, 0], atol=1e-3)
    assert found.fitness > 0.9 and np.linalg.eigvalsh(found.information).min() > 0
    assert found.iterations == 0 and found.converged and found.by_landmarks, "it stands whatever the guess"
    np.testing.assert_array_equal(registrar.register(target, source, I_FROM_J).i_from_j, found.i_from_j)
    target, source = (registrar.prepare(cloud) for cloud in frames_of(10))
    mean = registrar.register(target, source, np.eye(4))
    np.testing.assert_allclose(mean.i_from_j[:3, 3], [0.1, 0, 0], atol=5e-3)
    assert np.linalg.eigvalsh(found.information - mean.information).max() > 0 and mean.iterations > 0
    assert not mean.by_landmarks
    target, source = (registrar.prepare(cloud) for cloud in frames_of(6))
    assert abs(registrar.register(target, source, np.eye(4)).i_from_j[0, 3]) < 0.05


def twins(cloud: PointCloud) -> PointCloud:
    """The cloud with landmarks that look alike two by two, as the handles of a cabinet do."""
    marks = cloud.landmarks
    assert marks is not None
    half = len(marks) // 2
    return replace(cloud, landmarks=landmarks_at(marks.points_in_cam, np.tile(marks.descriptors[:half], (2, 1))))


def test_landmarks_that_look_alike_are_told_apart_by_where_they_are():
    target, source = (twins(cloud) for cloud in frames_of(60))
    blind, guided = Rgbd(guided_m=0), Rgbd()
    slid = blind.register(blind.prepare(target), blind.prepare(source), np.eye(4))
    assert abs(slid.i_from_j[0, 3]) < 0.05
    found = guided.register(guided.prepare(target), guided.prepare(source), np.eye(4))
    np.testing.assert_allclose(found.i_from_j[:3, 3], [0.1, 0, 0], atol=2e-3)
    assert found.fitness > 0.9 and found.iterations > 0


def test_guided_matches_lie_near_the_guess_and_are_mutual():
    target, source = (Rgbd().prepare(twins(cloud)) for cloud in frames_of(60))
    assert len(match(target.descriptors, source.descriptors, 0.8)) < 10  # twins differ by rounding alone
    pairs = guided_match(target, source, np.eye(4), 0.15)
    moved = np.linalg.norm(target.landmarks[pairs[:, 0]] - source.landmarks[pairs[:, 1]], axis=1)
    assert len(pairs) > 50 and (moved < 0.15).all()
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    assert (pairs[:, 0] == pairs[:, 1]).mean() > 0.9
    assert len(guided_match(target, source, np.eye(4), 0.01)) < 5
    bare = Rgbd().prepare(replace(frames_of(60)[0], landmarks=None))
    assert guided_match(bare, source, np.eye(4), 0.15).shape == (0, 2)


def no_icp(*_: object) -> None:
    raise AssertionError("ICP is run")


def test_landmarks_that_the_guess_tells_apart_need_no_icp(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Rgbd, "_by_surfaces", no_icp)
    registrar = Rgbd()
    target, source = (registrar.prepare(twins(cloud)) for cloud in frames_of(60))
    found = registrar.register(target, source, np.eye(4))
    np.testing.assert_allclose(found.i_from_j[:3, 3], [0.1, 0, 0], atol=2e-3)


def test_a_pair_of_which_too_little_lies_within_reach_is_not_registered(monkeypatch: pytest.MonkeyPatch):
    registrar, away = Rgbd(), np.eye(4)
    away[0, 3] = 1.5
    target, source = (registrar.prepare(cloud) for cloud in frames_of(0))
    assert registrar.register(target, source, np.eye(4)).fitness > 0.9
    monkeypatch.setattr(Rgbd, "_by_surfaces", no_icp)
    found = registrar.register(target, source, away)
    assert found.fitness == 0 and not found.converged
    np.testing.assert_array_equal(found.i_from_j, away)


def test_unlike_landmarks_near_a_guess_agree_on_nothing():
    target, source = frames_of(400)
    assert source.landmarks is not None
    other = np.random.default_rng(9).integers(0, 255, (400, 128), dtype=np.uint8)
    source = replace(source, landmarks=landmarks_at(source.landmarks.points_in_cam, other))
    found, alone = (
        one.register(one.prepare(target), one.prepare(source), np.eye(4)) for one in (Rgbd(), Rgbd(guided_m=0))
    )
    np.testing.assert_array_equal(found.i_from_j, alone.i_from_j)


def test_a_frame_with_much_behind_what_the_other_saw_is_not_lost():
    target, source = frames_of(40)
    behind = np.column_stack([np.random.default_rng(2).uniform(-3, 3, (20000, 2)), np.full(20000, 5.0)])
    assert source.normals_in_cam is not None
    wide = PointCloud(
        np.concatenate([source.points_in_cam, behind.astype(np.float32)]),
        np.concatenate([source.normals_in_cam, np.tile(source.normals_in_cam[:1], (20000, 1))]),
        None,
        source.landmarks,
    )
    registrar = Rgbd()
    found = registrar.register(registrar.prepare(target), registrar.prepare(wide), np.eye(4))
    np.testing.assert_allclose(found.i_from_j[:3, 3], [0.1, 0, 0], atol=1e-3)
    assert found.fitness > 0.9


def test_landmarks_survive_the_disk(tmp_path: Path):
    clouds = [*frames_of(5), PointCloud(np.zeros((0, 3), np.float32))]
    CloudSet.from_clouds(clouds).save(tmp_path)
    read = CloudSet.open(tmp_path)
    assert [len(cloud.landmarks or ()) for cloud in read] == [5, 5, 0]
    np.testing.assert_array_equal(read[1].landmarks.descriptors, clouds[1].landmarks.descriptors)
    np.testing.assert_array_equal(read[1].landmarks.pixel_rad, clouds[1].landmarks.pixel_rad)


@pytest.mark.parametrize("larger", [1, 3])
def test_a_pixel_of_a_landmark_is_one_of_the_image_and_an_angle(larger: int):
    """A camera of a quarter of the pixels covers four times the angle with each; a larger image makes it smaller."""
    frame = textured_frame()
    image = np.kron(frame.read_colour(), np.ones((larger, larger, 1), np.uint8))
    found = find_landmarks(replace(frame, read_colour=lambda: image), 100, 0.2, 6.0)
    np.testing.assert_allclose(found.pixel_rad, 1 / (larger * CAMERA.fx), rtol=1e-6)


def test_the_error_has_the_size_that_the_information_says_of_a_camera_of_few_pixels_too():
    squares = {525.0: [0.0], 130.0: [0.0]}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points_j = points_before(200, rng)
        points_i = se3.transform(I_FROM_J, points_j)
        points_i[:, :2] += rng.normal(0, 0.75 * np.sqrt(2) / 130, (200, 2)) * points_i[:, 2:]
        for focal, own in squares.items():
            found = motion_of(points_i, points_j, 1 / focal)
            assert found is not None
            error = se3.log(se3.inverse(I_FROM_J) @ found.i_from_j)
            own.append(error @ found.information @ error / 6)
    assert 0.2 < np.mean(squares[130.0]) < 3 < np.mean(squares[525.0])
