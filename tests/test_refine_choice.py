"""Which candidate of a refined model is kept: what tracks gain by fitting noise, and what depth held out says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.refine.candidates import CandidateModel, CandidateSet
from hodge_pipeline.refine.choice import UNTOLD, Choice, choose, refused_doubt
from hodge_pipeline.refine.model import _metric_poses
from hodge_pipeline.refine.reprojection_cost import costs
from hodge_pipeline.refine.uncertainty import likeliest, loose, told_apart
from hodge_pipeline.types import Floats, ModelQuality
from hodge_pipeline.types.tracked_model import PoseInformation
from test_reprojection_cost import flat, quality

DEPTHS = np.linspace(1.0, 3.0, 20)
NO_STEPS: Any = None
"""Nothing is to be computed."""


@dataclass
class Model:
    """As much of a model as a choice asks for: ten bodies in a row, moved by a tenth of their extent."""

    quality: ModelQuality
    moved: float = 0.0
    ratio: float = 1.0
    sigmas: tuple[float, ...] = (0.01,) * 10
    body_names = tuple("abcdefghij")
    known_positions = None
    moves_calibration = False

    @property
    def world_from_body(self) -> Floats:
        positions = np.outer(np.arange(10.0), [1.0, 0.0, 0.0]) + self.moved * np.eye(3)[np.arange(10) % 3]
        return se3.from_parts(np.broadcast_to(np.eye(3), (10, 3, 3)), positions)

    @property
    def frames(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(world_from_cam=pose) for pose in self.world_from_body]

    @property
    def information(self) -> PoseInformation:
        """Of each body by itself."""
        fixed = np.isfinite(self.sigmas)
        return PoseInformation(fixed, np.eye(6) / np.square(self.sigmas)[fixed, None, None])

    def merged(self) -> Model:
        return self

    def seen_depths(self) -> list[Floats]:
        return [np.stack([self.ratio * DEPTHS, DEPTHS, np.ones(20)], axis=1) for _ in range(10)]


def found(before_px: float, after_px: float, points: int = 40, ratio: float = 1.0, sigma: float = 0.01) -> CandidateSet:
    """The input and its bundle adjustment: 400 observations in ten images, of so many points."""
    parts = [
        replace(quality(flat(px, images=10, count=40)), points=points, mean_track_length=400 / points)
        for px in (before_px, after_px)
    ]
    models = [Model(parts[0]), Model(parts[1], moved=0.9, ratio=ratio, sigmas=(sigma,) * 10)]
    inputs, *costly = costs(parts[:1], parts)
    held_out = SimpleNamespace(held_out=np.zeros((8, 2), np.int64), graph=SimpleNamespace(edge_count=0))
    candidates: Any = [CandidateModel("as given", models[0], holds_poses=True), CandidateModel("bundle", models[1])]
    depth: Any = held_out
    return CandidateSet(inputs, candidates, costly, None, depth, ())


def apart(before_m: float, after_m: float) -> Floats:
    """Eight pairs held out, so far apart."""
    return np.array([[before_m], [after_m]]) + np.linspace(0.0, 0.002, 8)


def test_depth_held_out_refuses_what_tracks_alone_prefer() -> None:
    candidates = found(1.0, 0.3)
    assert choose(candidates, np.zeros((2, 0)), 0, NO_STEPS).row == 1
    assert choose(candidates, apart(0.01, 0.04), 0, NO_STEPS).row == 0


def test_an_input_that_is_kept_beside_a_much_better_candidate_is_in_doubt() -> None:
    no_depth, candidates = np.zeros((2, 0)), found(1.0, 0.3)
    assert refused_doubt(candidates, Choice(0, "held out"), no_depth) == (
        "in doubt, since bundle fits much better (1.00 → 0.30 px)"
    )
    assert refused_doubt(candidates, Choice(1, ""), no_depth) == ""
    assert refused_doubt(candidates, Choice(0, "depth"), apart(0.01, 0.04)) == "", "depth refuses it"
    assert refused_doubt(found(1.0, 0.8), Choice(0, "held out"), no_depth) == ""
    assert refused_doubt(found(1.0, 0.45, points=230), Choice(0, "noise"), no_depth) == "", "noise alone is fitted"


def test_depth_held_out_speaks_for_any_candidate() -> None:
    candidates = found(1.0, 0.9)
    assert "moves cameras" in choose(candidates, np.zeros((2, 0)), 0, NO_STEPS).reason
    assert choose(candidates, apart(0.04, 0.01), 0, NO_STEPS).row == 1


def test_what_poses_gain_by_fitting_noise_is_no_gain() -> None:
    """Of 800 numbers 230 points leave 110, ten poses 50 of those: noise alone shrinks by a third."""
    choice = choose(found(1.0, 0.7, points=230), np.zeros((2, 0)), 0, NO_STEPS)
    assert choice.row == 0 and "fitting noise" in choice.reason


@pytest.mark.parametrize(
    ("sigma", "nearer", "row"), [(0.01, 1.1, 1), (0.01, 100.0, 0), (0.5, 1.0, 0), (np.nan, 1.0, 0)]
)
def test_poses_that_tracks_hardly_fix_stay(sigma: float, nearer: float, row: int) -> None:
    """As where adjustment makes points at infinity near ones, which then seem to fix poses well."""
    candidates, no_depth = found(3.5, 0.6, sigma=sigma), np.zeros((2, 0))
    given: Any = candidates.candidates[0].model
    given.quality = replace(given.quality, parallaxes_deg=given.quality.parallaxes_deg / nearer)
    choice = choose(candidates, no_depth, 0, NO_STEPS)
    assert choice.row == row and (choice.refused == UNTOLD) == (row == 0)
    told = refused_doubt(candidates, choice, no_depth)
    assert told == ("" if row else "in doubt, since bundle fits much better (3.50 → 0.60 px)"), "the reason says why"
    if not row:
        told = refused_doubt(candidates, replace(choice, reason=""), no_depth)
        assert told.endswith(f"(3.50 → 0.60 px), but {UNTOLD}"), "where points alone are adjusted it gives no reason"


def test_one_image_that_tracks_hardly_fix_is_told_and_does_not_keep_the_others_from_better_poses() -> None:
    start, candidate = (one.model for one in found(3.5, 0.6).candidates)
    weak: Any = replace(candidate, sigmas=(2.0,) + (0.01,) * 9)
    assert told_apart(start, weak)
    np.testing.assert_array_equal(loose(start, weak), [True] + [False] * 9)
    assert not loose(start, candidate).any() and not told_apart(start, start)


@dataclass
class Row(Model):
    """Motions between neighbours are known to a hundredth of a step, but that of the fifth and sixth to ten."""

    shifted: float = 0.0

    @property
    def world_from_body(self) -> Floats:
        poses = super().world_from_body
        poses[5:, 1, 3] += self.shifted
        return poses

    @property
    def information(self) -> PoseInformation:
        bend, sigmas = np.zeros((6, 6)), np.full((9, 6), 0.01)
        bend[3:, :3], sigmas[4, 3:] = se3.hat(np.array([1.0, 0.0, 0.0])), 10.0
        steps = np.kron(np.diff(np.eye(10), axis=0), np.eye(6)) + np.kron(np.eye(10)[:9], bend)
        joint = steps.T @ (steps / sigmas.reshape(-1, 1) ** 2)
        return PoseInformation(np.ones(10, bool), joint[None])


def test_poses_that_are_all_off_are_mended_though_one_link_is_loose_and_not_moved_along_that_link() -> None:
    given = quality(flat(1.0, images=10, count=40))
    start, all_moved, halves_moved = Row(given), Row(given, moved=0.9), Row(given, shifted=0.9)
    assert np.median(all_moved.information.standard_errors[:, 1]) > 0.9, "most are known less well than they moved"
    models: Any = start, all_moved, halves_moved
    assert told_apart(*models[:2]) and not told_apart(*models[::2])


def test_most_likely_poses_are_those_of_the_tracks_and_along_a_loose_link_those_of_the_start() -> None:
    """The start is noisy and one of its poses was carried away; the halves of the model were shifted by 0.9."""
    given = quality(flat(1.0, images=10, count=40))
    noise = np.random.default_rng(0).normal(scale=0.1, size=(10, 6))
    noise[2, 4] = 50.0
    models: Any = Row(given), Row(given, shifted=0.9)
    y = likeliest(models[0].world_from_body @ se3.exp(noise), models[1])[:, 1, 3]
    assert np.ptp(y[:5]) < 0.1 and np.ptp(y[5:]) < 0.1 and abs(y[5:].mean() - y[:5].mean()) < 0.4


def test_candidates_are_laid_on_the_clouds_in_metres_each_by_its_own_depth() -> None:
    before, after = _metric_poses(found(1.0, 0.9, ratio=2.0))
    np.testing.assert_allclose(np.ptp(before[:, 0, 3]), 9.0)
    np.testing.assert_allclose(np.ptp(after[:, 0, 3]), 18.0)
