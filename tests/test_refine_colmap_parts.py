"""Parts of a COLMAP model that too few points tie: told, and laid by themselves."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, disturbed
from hodge_adapters.colmap.models import ColmapModels
from hodge_pipeline import se3
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine import candidates
from hodge_pipeline.refine.frame import in_frame_of, parts_laid_on, similarity
from hodge_pipeline.refine.pieces import parts


def in_two_parts(shared: int) -> pycolmap.Reconstruction:
    """Eight images of exact points, the first three and the others of points of their own but for so many."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 60
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    apart = {image.name for image in sorted(model.images.values(), key=lambda one: one.name)[:3]}
    seen = {key: [(e.image_id, e.point2D_idx) for e in point.track.elements] for key, point in model.points3D.items()}
    for key, elements in list(seen.items())[shared:]:
        for image_id, column in elements:
            is_other = (model.images[image_id].name in apart) != (key % 2 == 0)
            if is_other and model.images[image_id].points2D[column].has_point3D():
                model.delete_observation(image_id, column)
    return model


@pytest.mark.parametrize("shared", [0, 1, 3, 60])
def test_images_that_share_too_few_points_with_the_others_are_in_doubt(shared: int) -> None:
    """One point that both halves see leaves them as free as none; three are points that fix a pose."""
    (cut,) = hodge_pipeline.refine_colmap(in_two_parts(shared), database="none", overrides=FREE).results
    told = "in doubt, since 3 images (", "share no points with the others, or too few"
    assert (cut.decision.doubt.startswith(told[0]), cut.decision.doubt.endswith(told[1])) == (shared < 3,) * 2


def with_points_off(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    rng = np.random.default_rng(0)
    for point in model.points3D.values():
        point.xyz = point.xyz + rng.normal(scale=0.2, size=3)
    return model


def test_parts_that_too_few_points_tie_are_laid_on_poses() -> None:
    near, whole = (ColmapModels(database="none").open_models([in_two_parts(shared)])[0] for shared in (1, 60))
    poses, part = near.world_from_body, parts(near)
    assert sorted(np.bincount(part)) == [3, 5]
    motions = np.stack([np.eye(4), se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))])
    moved = near.scaled_parts(part, np.array([1.0, 1.5]), motions)
    assert absolute_error(moved.world_from_body, poses, with_scale=True).rmse_m > 0.1
    laid = parts_laid_on(poses, moved)
    np.testing.assert_allclose(laid.world_from_body, poses, atol=1e-9)
    np.testing.assert_allclose(laid.quality.errors_px, near.quality.errors_px, atol=1e-6)
    assert parts_laid_on(poses, whole) is whole


def test_a_part_is_laid_by_positions_and_turns_as_each_is_noisy() -> None:
    """A row of images, turned but little, whose positions leave the turn about it open; two were carried away."""
    rng, size = np.random.default_rng(0), (20, 3)
    places = np.linspace(0, 10, 20)[:, None] * [1.0, 0.0, 0.0] + 0.01 * rng.normal(size=size)
    after = se3.from_parts(se3.exp(rng.normal(size=(20, 6)))[:, :3, :3], places)
    motion, noise = (
        se3.exp(np.array([0.3, 0.2, 0.1, 1.0, 2.0, 3.0])),
        rng.normal(scale=[0.1] * 3 + [0.05] * 3, size=(20, 6)),
    )
    noise[:2] = [[0.8, 0.8, 0.8, 5.0, 5.0, 5.0]]
    factor, found = similarity(after, motion @ se3.rescaled(after, 2.0) @ se3.exp(noise), keeps_size=False)
    assert abs(factor - 2.0) < 0.02
    off = se3.log(se3.inverse(found) @ motion)
    assert abs(off[0]) < 0.1 and np.abs(off[1:3]).max() < 0.01 and np.abs(off[3:]).max() < 0.2


def test_parts_of_a_refined_model_lie_as_a_point_and_the_start_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a pixel of noise: the one point that both parts see tells some of it, and misleads where it alone counts."""
    model, rng = with_points_off(in_two_parts(1)), np.random.default_rng(1)
    true = ColmapModels(database="none").open_models([model])[0].world_from_body
    for image in model.images.values():
        for keypoint in image.points2D:
            keypoint.xy = keypoint.xy + rng.normal(scale=0.5, size=2)
    model.write(tmp_path)
    given, off_m = pycolmap.Reconstruction(disturbed(tmp_path, tmp_path / "off")), []
    for poses in (candidates.likeliest, lambda _, model: model.world_from_body):
        monkeypatch.setattr(candidates, "likeliest", poses)
        (result,) = hodge_pipeline.refine_colmap(given, database="none", overrides=FREE).results
        off_m.append(absolute_error(result.model.world_from_body, true, with_scale=True).rmse_m)
    assert off_m[0] < 0.5 * off_m[1]


def test_parts_whose_points_are_right_lie_by_the_points(tmp_path: Path) -> None:
    in_two_parts(0).write(tmp_path)
    true = ColmapModels(database="none").open_models(tmp_path)[0].world_from_body
    off = disturbed(tmp_path, tmp_path / "off", degrees=8.0, share=0.15)
    (result,) = hodge_pipeline.refine_colmap(off, database="none", overrides=FREE).results
    assert absolute_error(result.model.world_from_body, true, with_scale=True).rmse_m < 1e-3


def test_positions_that_are_all_one_leave_the_size_as_it_is() -> None:
    """As of a camera that only turns: they tell no size, and poses of size 0 would be no numbers."""
    one = se3.from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), np.zeros((4, 3)))
    spread = se3.from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), np.eye(4)[:, :3])
    start, model = (SimpleNamespace(world_from_body=poses, body_from_cam=one) for poses in (one, spread))
    assert in_frame_of(start, model) is model  # type: ignore[arg-type]
