"""One robust cost of each candidate: the same observations, those behind a camera or without parallax at the cap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hodge_pipeline
from colmap_data import FREE, noisy
from hodge_adapters.colmap import uncertainty
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.uncertainty import information
from hodge_pipeline import se3
from hodge_pipeline.refine.reprojection_cost import best, costs, mends, spoilt_doubt
from hodge_pipeline.refine.uncertainty import moves
from hodge_pipeline.types import ModelQuality
from hodge_pipeline.types.arrays import rms

BEYOND_ANY_IMAGE_PX = 1e9
Errors = dict[tuple[str, int], float]


def quality(errors_px: Errors, *, parallax_deg: float = 10.0, length: int = 6) -> ModelQuality:
    """A model with these errors at keypoints of images by name."""
    names = tuple(sorted({name for name, _ in errors_px}))
    keypoints = np.array([(names.index(name), column) for name, column in errors_px])
    values = np.array(list(errors_px.values()))
    parallaxes, lengths = np.full(len(values), parallax_deg), np.full(len(values), length)
    return ModelQuality(
        len(names), 1, 1.0, names, keypoints, values, parallaxes, lengths, np.zeros(len(values), np.int64)
    )


def flat(error_px: float, *, images: int = 2, count: int = 100) -> Errors:
    """So many observations in each image, all off by the same."""
    return {(f"image {row}", column): error_px for row in range(images) for column in range(count)}


def turned_round(model: Path, out: Path) -> Path:
    """The model with its first body turned by half a circle about its own vertical: it sees nothing any more."""
    moved = pycolmap.Reconstruction(model)
    frame = moved.frames[min(moved.reg_frame_ids())]
    half = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    matrix = half @ np.vstack([frame.rig_from_world.matrix(), [0.0, 0.0, 0.0, 1.0]])
    frame.rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3]))
    out.mkdir()
    moved.write_binary(out)
    return out


def test_an_observation_behind_a_camera_or_lost_counts_as_the_cap() -> None:
    behind = {**flat(1.0), ("image 0", 0): np.inf}
    lost = {key: value for key, value in flat(1.0).items() if key != ("image 1", 0)}
    given, second, third = costs([quality(flat(1.0))], [quality(behind), quality(lost)])
    assert (given.px, given.behind, given.cap_px) == (pytest.approx(1.0), 0, 4.0)
    assert second.px == third.px == pytest.approx(1.0 + 3.0 / 200)
    assert (second.behind, third.behind) == (1, 1)


def test_one_observation_near_the_plane_of_its_camera_does_not_decide() -> None:
    given, other = costs([quality(flat(1.0))], [quality({**flat(0.9), ("image 0", 0): 1e34})])
    assert other.px == pytest.approx(0.9 + 3.1 / 200) and best([given, other]) == 1


def test_points_sent_to_infinity_win_nothing() -> None:
    far = quality(flat(0.1), parallax_deg=0.01)
    given, near, distant = costs([quality(flat(1.0))], [quality(flat(0.9)), far])
    assert (distant.distant, distant.px, near.distant) == (200, pytest.approx(4.0), 0)
    assert best([given, near, distant]) == 1


def test_what_most_see_without_parallax_does_not_count() -> None:
    sky = {("image 0", column): 50.0 for column in range(100, 120)}
    ground = quality({**flat(1.0), **sky})
    ground.parallaxes_deg[-20:] = 0.1
    given, other = costs([ground], [ground])
    assert given.observations == 200 and given.px == other.px == pytest.approx(1.0)


def test_points_of_two_images_count_by_what_they_leave_over() -> None:
    two, many = quality({("a", 0): 4.0}, length=2), quality({("b", 0): 1.0}, length=15)
    (both, _) = costs([two, many], [quality({("a", 0): 4.0, ("b", 0): 1.0})])
    assert both.px == pytest.approx((0.25 * 4.0 + 0.9 * 1.0) / 1.15)


def test_an_image_that_is_off_is_named_and_the_candidate_not_sound() -> None:
    off = {key: (50.0 if key[0] == "image 3" else 1.0) for key in flat(1.0, images=40)}
    given, right = costs([quality(off)], [quality(flat(1.0, images=40))])
    assert given.images_off == ("image 3",) and given.beyond == pytest.approx(1 / 40)
    assert not given.is_sound and right.is_sound
    assert given.images_doubt == "in doubt, since most observations of 1 image (image 3) are more than 4 px off"
    assert not given.doubt and not right.images_doubt


def test_observations_that_come_near_are_mended_where_chance_does_not_bring_as_many() -> None:
    """Few of many weigh nothing in the mean, and are all that tells how two halves lie to each other."""
    tied = {("image 0", column): 50.0 for column in range(100, 125)}
    given, mended, other = costs(
        [quality({**flat(1.0), **tied})],
        [
            quality({**flat(0.99), **dict.fromkeys(tied, 1.0)}),
            quality({**flat(1.0), **dict.fromkeys(list(tied)[:8], 1.0)}),
        ],
    )
    assert mends(given, mended) and not mends(mended, given) and not mends(given, other)
    spoilt = quality({**flat(0.99), **{key: 9.0 for key in flat(1.0, images=1)}, **dict.fromkeys(tied, 1.0)})
    before, after = costs([quality({**flat(1.0), **tied})], [spoilt])
    assert not mends(before, after), "it puts an image off"


def test_poses_are_in_doubt_where_most_observations_are_off_whatever_else_fits() -> None:
    half = {**flat(0.1), **flat(9.0, images=1)}
    given, *others = costs([quality(flat(913.0))], [quality(flat(0.1)), quality(half)])
    assert given.doubt == "in doubt, since 100% of the observations are more than 4 px off"
    assert [cost.doubt for cost in others] == ["", ""]
    assert replace(given, px=4.0 + 1e-12).doubt == given.doubt, "a mean of the cap rounds up or down"


def test_of_candidates_at_one_optimum_the_first_is_kept() -> None:
    found = costs([quality(flat(1.0))], [quality(flat(1.0 - 1e-6)), quality(flat(1.0 - 1e-7))])
    assert best(found) == 0


def test_an_observation_of_two_models_counts_once() -> None:
    parts = [quality({("a", 0): 1.0}), quality({("a", 0): 2.0, ("b", 0): 3.0})]
    apart, joined = costs(parts, [quality({("b", 0): 1.0, ("a", 0): 1.0, ("new", 7): 60.0})])
    assert (apart.observations, apart.px, joined.px) == (2, pytest.approx(2.0), pytest.approx(1.0))


def test_what_fits_better_but_spoils_what_fitted_is_in_doubt() -> None:
    """As a facade laid on its copy: most observations agree, those that show the difference do not."""
    names = [f"image {row}" for row in range(10)]
    before = flat(0.5, images=10, count=10) | {(name, 0): 60.0 for name in names}
    found = [flat(0.5, images=10, count=10) | {(name, 1): 60.0 for name in names[:count]} for count in (5, 6)]
    _, given, fit, spoils = costs([quality(before)], [quality(before), *map(quality, found)])
    assert fit.px < given.px and spoils.px < given.px
    assert not spoilt_doubt(given, fit) and spoilt_doubt(given, spoils).startswith("in doubt, since 6% of the obs")


def test_errors_are_those_of_pycolmap(tmp_path: Path) -> None:
    (model,) = ColmapModels(database="none", images="none").open_models(noisy(tmp_path))
    theirs = pycolmap.Reconstruction(tmp_path / "model")
    theirs.update_point_3d_errors()
    lengths = np.array([theirs.points3D[key].track.length() for key in model.records.points.ids.tolist()])
    means = np.add.reduceat(model.quality.errors_px, np.r_[0, np.cumsum(lengths)[:-1]]) / lengths
    np.testing.assert_allclose(means, [theirs.points3D[key].error for key in model.records.points.ids.tolist()])


def test_one_point_near_the_plane_of_a_camera_does_not_make_every_pose_uncertain(tmp_path: Path) -> None:
    right = pycolmap.Reconstruction(noisy(tmp_path))
    wrong = pycolmap.Reconstruction(right)
    point = wrong.points3D[min(wrong.points3D)]
    cam_from_world = wrong.images[point.track.elements[0].image_id].cam_from_world()
    in_cam = cam_from_world * point.xyz
    point.xyz = cam_from_world.inverse() * np.array([in_cam[0], in_cam[1], 1e-2])
    sure, unsure = (
        np.sqrt((information(model.records, model.bodies).standard_errors ** 2).mean(axis=0))
        for model in (ColmapModels(database="none", images="none").open_models([one])[0] for one in (right, wrong))
    )
    np.testing.assert_allclose(unsure, sure, rtol=0.05)


def test_wrong_observations_make_poses_as_uncertain_as_they_pull_on_them(tmp_path: Path) -> None:
    """5 % of the observations are wrong by 15 px: poses err by what their share of the squared residuals says."""
    right = pycolmap.Reconstruction(noisy(tmp_path))
    (true,), rng, errors, stated = ColmapModels(database="none").open_models([right]), np.random.default_rng(0), [], []
    for _ in range(4):
        wrong = pycolmap.Reconstruction(right)
        for point in wrong.points3D.values():
            for seen in point.track.elements:
                if rng.random() < 0.05:
                    keypoint = wrong.images[seen.image_id].points2D[seen.point2D_idx]
                    keypoint.xy = keypoint.xy + 15.0 * rng.normal(size=2)
        adjusted = ColmapModels(database="none").open_models([wrong])[0].adjusted()
        errors.append(moves(true.world_from_body, adjusted.world_from_body)[:, 0])
        stated.append(np.sqrt(3) * adjusted.information.standard_errors[:, 0])
        robust = information(adjusted.records, adjusted.bodies, robust=True).standard_errors[:, 0]
        assert (np.sqrt(3) * robust < 0.5 * stated[-1]).all()
    assert 0.6 < rms(np.array(errors)) / rms(np.array(stated)) < 1.6


def test_a_body_that_sees_nothing_does_not_make_the_others_uncertain(tmp_path: Path) -> None:
    full = pycolmap.Reconstruction(noisy(tmp_path))
    blind = pycolmap.Reconstruction(full)
    frame_id = min(blind.reg_frame_ids())
    for data in blind.frames[frame_id].image_ids:
        for column, seen in enumerate(blind.images[data.id].points2D):
            if seen.has_point3D():
                blind.delete_observation(data.id, column)
    models = [ColmapModels(database="none", images="none").open_models([one])[0] for one in (full, blind)]
    sure, unsure = (information(model.records, model.bodies).standard_errors for model in models)
    unseen = np.array(models[1].bodies.frame_ids) == frame_id
    assert np.isnan(unsure[unseen]).all()
    assert (unsure[~unseen] < 1.5 * sure[~unseen]).all()


def test_blocks_of_many_bodies_are_those_of_their_joint_normal_matrix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (model,) = ColmapModels(database="none", images="none").open_models(noisy(tmp_path))
    poses = model.records.world_from_cam
    count = len(poses)
    each = np.arange(count)
    alone = np.tile(np.eye(4), (count, 1, 1))
    bodies = replace(model.bodies, world_from_body=poses, body_of_image=each, body_from_cam=alone)
    given = model.records, bodies, np.ones(len(model.quality.errors_px), bool), each, count
    jointly = uncertainty._schur(*given).reshape(count, 6, count, 6)[each, :, each]
    monkeypatch.setattr(uncertainty, "MOST_BODIES_JOINTLY", 0)
    np.testing.assert_allclose(uncertainty._schur(*given), jointly, rtol=1e-6, atol=1e-6 * jointly.max())


def test_no_number_of_a_refinement_is_that_of_a_point_behind_a_camera(tmp_path: Path) -> None:
    start = turned_round(noisy(tmp_path), tmp_path / "start")
    raw = pycolmap.Reconstruction(start)
    raw.update_point_3d_errors()
    assert raw.compute_mean_reprojection_error() > 1e100, "pycolmap's own mean is that of its sentinel"
    done = hodge_pipeline.refine_colmap(start, database="none", out=tmp_path / "out", overrides=FREE)
    (result,) = done.results
    behind, mean = result.decision.measures[:2]
    assert behind.before == np.isinf(result.start.quality.errors_px).sum() > 100
    assert max(mean.before, mean.after) < BEYOND_ANY_IMAGE_PX
    report = json.loads((tmp_path / "out/report.json").read_text())["refinement"]
    assert [row["name"] for row in report["measures"][:2]] == [behind.name, mean.name]
    assert all(abs(row[when]) < BEYOND_ANY_IMAGE_PX for row in report["measures"] for when in ("before", "after"))
    assert all(row["mean_px"] <= 4.0 for row in report["candidates"])
    moved = result.start.moved(result.start.world_from_body).reconstruction
    assert all(point.error < BEYOND_ANY_IMAGE_PX for point in moved.points3D.values())
    assert "e+1" not in result.decision.reason
