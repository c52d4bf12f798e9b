"""The contract of readers of models, and of the models that they give, one named property after the other."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import ModelReader
from hodge_pipeline.testing.readers import check_view_graph
from hodge_pipeline.testing.stage import Contract, raises
from hodge_pipeline.types import Floats
from hodge_pipeline.types.tracked_model import TrackedModel

NEAR = 1e-6
"""What a file of 17 digits and a few products of matrices lose."""
FEW_SEEN = 5
"""Observations of an image in a thinned model."""


@dataclass(frozen=True)
class _Case:
    reader: ModelReader
    path: Path


def _model(case: _Case) -> TrackedModel:
    models = case.reader.open_models(case.path)
    assert len(models), "it opens no model: raise SourceError instead"
    return models[0]


def _refuses_what_is_not_there(case: _Case) -> None:
    nowhere = case.path / "a folder that is not there"
    message = raises(SourceError, lambda: case.reader.open_models(nowhere))
    assert message is not None, "a path that is not there must raise SourceError"
    assert str(nowhere) in message, f"the error does not name the path: {message}"


def _fits_together(case: _Case) -> None:
    model = _model(case)
    bodies, frames = len(model.body_names), len(model.frames)
    assert len(set(model.body_names)) == bodies, "two bodies have one name"
    assert model.world_from_body.shape == (bodies, 4, 4), f"{bodies} bodies, poses {model.world_from_body.shape}"
    assert model.body_of_frame.shape == (frames,), f"{frames} frames, but body_of_frame {model.body_of_frame.shape}"
    carried = model.world_from_body[model.body_of_frame] @ model.body_from_cam
    own = np.array([frame.world_from_cam for frame in model.frames])
    _assert_near(carried, own, "the frames' poses are not where their bodies carry them")
    assert all(file.is_file() for file in model.files), "it names files that are not there"


def _measures(case: _Case) -> None:
    model = _model(case)
    graph, left_out = model.measured()
    check_view_graph(graph)
    assert graph.vertex_count == len(model.body_names), "the vertices of the measured graph are not the bodies"
    assert all(isinstance(note, str) for note in left_out), "what was left out is told in sentences"


def _sees_points(case: _Case) -> None:
    model = _model(case)
    seen = model.seen_points()
    assert len(seen) == len(model.body_names), f"{len(model.body_names)} bodies, points of {len(seen)}"
    assert len(seen.points), "no body sees a point"
    twice = np.asarray(model.scaled(2.0).seen_points().points, float)
    _assert_near(twice, 2.0 * np.asarray(seen.points, float), "seen points are not in the model's unit")


def _is_scaled(case: _Case) -> None:
    model = _model(case)
    before = model.world_from_body
    after = model.scaled(2.0).world_from_body
    _assert_near(after[:, :3, 3], 2 * before[:, :3, 3], "twice the scale does not double the positions")
    _assert_near(after[:, :3, :3], before[:, :3, :3], "the scale turns bodies")
    motion = se3.exp(np.full(6, 0.5))
    _assert_near(model.scaled(1.0, motion).world_from_body, motion @ before, "the whole is not moved by the motion")
    _assert_near(model.world_from_body, before, "scaling a model changes the model itself")


def _is_thinned(case: _Case) -> None:
    model = _model(case)
    assert model.thinned(len(model.quality.errors_px)) is model, "tracks are left out of a model that has few"
    seen, left = (np.bincount(one.quality.keypoints[:, 0]) for one in (model, model.thinned(FEW_SEEN)))
    assert (left >= np.minimum(seen, FEW_SEEN)).all(), "an image is left with fewer observations than were asked for"
    assert seen.max() <= FEW_SEEN or left.sum() < seen.sum(), "no track is left out"


def _is_moved(case: _Case) -> None:
    model = _model(case)
    before = model.world_from_body
    wanted = before @ se3.exp(0.001 * np.random.default_rng(0).normal(size=(len(before), 6)))
    _assert_near(model.moved(wanted).world_from_body, wanted, "moved bodies are not at the poses that were given")
    _assert_near(model.world_from_body, before, "moving a model changes the model itself")


def _is_adjusted(case: _Case) -> None:
    model = _model(case)
    found = model.adjusted(move_bodies=False)
    told = getattr(found, "has_converged", None)
    assert isinstance(told, bool), "an adjusted model does not tell whether its adjustment converged (has_converged)"
    _assert_near(found.world_from_body, model.world_from_body, "bodies move where points alone are adjusted")


def _is_read_back(case: _Case) -> None:
    model = _model(case)
    with tempfile.TemporaryDirectory() as name:
        model.write(Path(name))
        again = model.read_back(Path(name), ("a note",))
        assert again.body_names == model.body_names, "bodies have other names when read back"
        _assert_near(again.world_from_body, model.world_from_body, "poses are others when read back")
        assert again.notes == ("a note",), "the notes are lost"
        assert case.reader.open_models(Path(name)), "its own reader does not open what it has written"


def _assert_near(found: Floats, wanted: Floats, what: str) -> None:
    off = float(np.abs(found - wanted).max(initial=0.0))
    assert off <= NEAR * max(1.0, float(np.abs(wanted).max(initial=0.0))), f"{what}: off by {off:.2g}"


check_model_reader = Contract(
    ModelReader,
    {
        "no such path": _refuses_what_is_not_there,
        "bodies and frames": _fits_together,
        "measured": _measures,
        "seen points": _sees_points,
        "another unit": _is_scaled,
        "thinned": _is_thinned,
        "moved": _is_moved,
        "adjusted": _is_adjusted,
        "read back": _is_read_back,
    },
    _Case,
)
"""Checks a reader of models on the model at a path: `check_model_reader(reader, path)`."""
