"""The contract of registrars, one named property after the other."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.stages import Registrar
from hodge_pipeline.testing.stage import PAIR, TURNED, Contract, nothing, off_by, room, seen_from
from hodge_pipeline.types import Floats, PointCloud, Registration

EXACT = 0.003, 0.01
"""Radians and metres that two clouds of a 4 cm grid leave; the guess is off by ten times as much."""
SLIDES = 0.02
"""The weakest direction's share of the information on translation, below which acceptance rejects a pair."""


class Pair(NamedTuple):
    """Cloud i, cloud j and the true i_from_j (4, 4)."""

    target: PointCloud
    source: PointCloud
    truth: Floats


def _pair() -> Pair:
    """Two views of the room."""
    scene = room()
    i, j = (scene.frames[row].world_from_cam for row in PAIR)
    assert i is not None and j is not None
    return Pair(scene.clouds[PAIR[0]], scene.clouds[PAIR[1]], se3.inverse(i) @ j)


def _registered(registrar: Registrar, target: PointCloud, source: PointCloud, guess: Floats) -> Registration:
    """The registration, after asserting that it has the form of one and that nothing given was changed."""
    before = pickle.dumps((target, source, guess))
    found = registrar.register(registrar.prepare(target), registrar.prepare(source), guess)
    assert pickle.dumps((target, source, guess)) == before, "it changes the clouds or the guess that it is given"
    assert isinstance(found, Registration), f"register gives a {type(found).__name__}"
    assert found.i_from_j.shape == (4, 4) and found.i_from_j.dtype == np.float64, "i_from_j is float64 (4, 4)"
    assert se3.is_motion(found.i_from_j, 1e-6), "i_from_j is not a rigid motion"
    information = found.information
    assert information.shape == (6, 6) and np.isfinite(information).all(), "information is finite, (6, 6)"
    scale = max(np.abs(information).max(), 1.0)
    assert np.abs(information - information.T).max() <= 1e-9 * scale, "information is not symmetric"
    assert np.linalg.eigvalsh(information)[0] >= -1e-9 * scale, "information is not positive semi-definite"
    assert 0 <= found.fitness <= 1, f"fitness is {found.fitness}: a share in [0, 1]"
    assert found.correspondences >= 0 and found.iterations >= 0, "a count is negative"
    assert found.correspondences == 0 or found.rmse_m >= 0, f"rmse_m is {found.rmse_m}"
    return found


def _assert_near(found: Registration, truth: Floats, what: str) -> None:
    angle, distance_m = off_by(found.i_from_j, truth)
    assert angle <= EXACT[0] and distance_m <= EXACT[1], f"{what}: off by {angle:.2g} rad and {distance_m:.2g} m"
    assert found.converged and found.correspondences > 0, f"{what}: found, but called not converged"


def _finds_the_motion(registrar: Registrar) -> None:
    target, source, truth = _pair()
    found = _registered(registrar, target, source, np.eye(4))
    _assert_near(found, truth, "two views of a room")
    assert np.linalg.eigvalsh(found.information)[0] > 0, "two views of a room hold each other, the information does not"


def _starts_at_the_guess(registrar: Registrar) -> None:
    target, source, truth = _pair()
    guess = se3.inverse(TURNED)
    found = _registered(registrar, target, seen_from(source, TURNED), guess)
    _assert_near(found, truth @ guess, "with cloud j in other axes, and a guess i_from_j that undoes them")


def _repeats_itself(registrar: Registrar) -> None:
    one, two, _ = _answers(registrar)  # type: ignore[arg-type]
    assert one == two, "the same pair gives other bits when registered again"


def _keeps_nothing_of_a_pair(registrar: Registrar) -> None:
    fresh, _, kept = _answers(registrar)  # type: ignore[arg-type]
    assert kept == fresh, "prepared clouds that were registered before give other bits"


@lru_cache(maxsize=1)  # two properties are of the same answers, and a process costs seconds
def _answers(registrar: Registrar) -> list[bytes]:
    """The same pair registered twice from clouds prepared anew, and from clouds that met others before.

    In a worker process, where a run registers: open3d may differ by last bits in a process that loaded it otherwise.
    """
    clouds = [room().clouds[row] for row in (*PAIR, PAIR[1] + 1)]
    with LocalExecutor(workers=1, retries=0).open() as workers:
        ((_, answers),) = workers.map(partial(_answered, registrar), [clouds])
    return answers


def _answered(registrar: Registrar, clouds: list[PointCloud]) -> list[bytes]:
    fresh = [_registered(registrar, clouds[0], clouds[1], np.eye(4)) for _ in range(2)]
    kept = [registrar.prepare(cloud) for cloud in clouds]
    registrar.register(kept[2], kept[1], np.eye(4))
    registrar.register(kept[0], kept[2], np.eye(4))
    return [pickle.dumps(found) for found in (*fresh, registrar.register(kept[0], kept[1], np.eye(4)))]


def _passes_over_points_that_are_not_finite(registrar: Registrar) -> None:
    target, source, truth = _pair()
    points = source.points_in_cam.copy()
    points[::50] = np.nan
    found = _registered(registrar, target, replace(source, points_in_cam=points), np.eye(4))
    _assert_near(found, truth, "with points that are not finite")


def _says_where_nothing_is_shared(registrar: Registrar) -> None:
    target = _pair().target
    far = seen_from(replace(target, landmarks=nothing().landmarks), se3.exp(np.array([0, 0, 0, 1000.0, 0, 0])))
    few = PointCloud(target.points_in_cam[:3], None, None, nothing().landmarks)
    for what, one, two in (
        ("an empty source", target, nothing()),
        ("an empty target", nothing(), target),
        ("a cloud a kilometre away", target, far),
        ("a cloud of three points", target, few),
    ):
        found = _registered(registrar, one, two, np.eye(4))
        assert not found.converged, f"{what}: called converged"
        assert np.isfinite(found.i_from_j).all(), f"{what}: the motion is not finite"
    found = _registered(registrar, target, nothing(), np.eye(4))
    assert found.correspondences == 0 and not found.information.any(), "an empty source: there is some information"


def _knows_that_a_wall_slides(registrar: Registrar) -> None:
    rng = np.random.default_rng(0)
    walls = [rng.uniform(-1, 1, (4000, 3)) * [1, 1, 0.001] + [0, 0, 2.0] for _ in range(2)]
    facing = np.tile(np.array([0, 0, -1.0], np.float32), (4000, 1))
    target, source = (
        PointCloud(points.astype(np.float32), facing, np.full((4000, 3), 128, np.uint8), nothing().landmarks)
        for points in walls
    )
    found = _registered(registrar, target, source, np.eye(4))
    values = np.linalg.eigvalsh(found.information[3:, 3:])
    assert values[0] <= SLIDES * values.sum(), "a bare wall is said to be held in every direction"


check_registrar = Contract(
    Registrar,
    {
        "known motion": _finds_the_motion,
        "other axes": _starts_at_the_guess,
        "the same bits again": _repeats_itself,
        "prepared once": _keeps_nothing_of_a_pair,
        "points not finite": _passes_over_points_that_are_not_finite,
        "nothing in common": _says_where_nothing_is_shared,
        "a bare wall": _knows_that_a_wall_slides,
    },
)
"""Checks a registrar on two views of a room."""
