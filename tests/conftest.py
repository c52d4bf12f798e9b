"""Where the real data lies: `HODGE_DATA`, else `shared/data` beside the checkout. It is never part of the project.

And what keeps the tests cheap: the longest files begin first, plots of one kind are drawn once, textures are made once
a process, and nothing waits for the disk.
"""

from __future__ import annotations

import atexit
import gc
import hashlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from plugin_metadata import write_metadata

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, which says why
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or each of many children compiles all that it imports
gc.disable()  # until all is collected: what is imported stays
settings.load_profile("ci")  # everywhere the same examples, and none has a deadline
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY))  # for benchmarks/, which is no part of the package
if find_spec("hodge_paper") is None:  # the plugin with the paper's solver: `make setup` installs it
    PLUGIN = REPOSITORY / "benchmarks" / "paper" / "method"
    sys.path += [str(PLUGIN), found := tempfile.mkdtemp(prefix="hodge-paper-")]
    atexit.register(shutil.rmtree, found)
    write_metadata(PLUGIN, Path(found))


def find_data_dir() -> Path:
    """The folder with the real data sets, whether it exists or not."""
    return Path(os.environ.get("HODGE_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder with the real data sets; the test skips, with the reason, where it is absent."""
    path = find_data_dir()
    if not path.is_dir():
        pytest.skip(f"no real data at {path}: set HODGE_DATA to the folder that holds seven_scenes, tum, …")
    return path


LONGEST = (
    "review_browser", "stage_contracts", "tracking", "backbone_doubted", "lidar", "never_worse", "solver_robust",
    "backbone", "backbone_places", "faults", "backbone_breaks", "refine_colmap_joins", "sweeps", "refine_trajectory",
    "run_folder", "pipeline", "suggested_rounds", "fitted_camera", "executors", "refine_colmap", "golden", "notebooks",
    "two_hosts", "moving", "backbone_trust", "backbone_window", "cli_edit", "backbone_sessions", "new_plugin",
    "refined_trajectory", "recording_run", "recipe_mcap", "diagnosis_real_data", "docs",
)  # fmt: skip
"""Files that take longest: begun last, one would keep a processor alone."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {f"test_{name}": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_collection_finish() -> None:
    gc.freeze()  # or each collection goes through all that the libraries have left
    gc.enable()


def folder_of_all(config: pytest.Config) -> Path:
    """The base of temporary folders that all workers of this run have in common."""
    base = config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
    return base.parent if hasattr(config, "workerinput") else base


@pytest.fixture(scope="session")
def shared_base(request: pytest.FixtureRequest) -> Path:
    """The base of temporary folders that all workers of this run have in common: what is put there is made once."""
    return folder_of_all(request.config)


_textures: dict[str, object] = {}


@pytest.hookimpl(wrapper=True)  # a fixture would come after those of a module, which make most of the runs
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Every plot is drawn in tests that are marked `draws`, and elsewhere the first of a kind of data.

    So are pictures of scenes. All are a fifth of what a small run costs; gaps between points, which stay open, a tenth.
    A run waits for the disk 200 times, which costs a tenth too and tells nothing while the power stays on.
    """
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("draws") is None:
            patch.setattr("hodge_pipeline.report.raster._filled", lambda image, *_: image)
            draw_once(patch, folder_of_all(item.config))
        texture_once(patch)
        patch.setattr("os.fsync", lambda _: None)
        return (yield)


def draw_once(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Keep the first plot, and the first pictures of a scene, of each kind of data for all that come later."""
    from hodge_pipeline.report import diagnosis_plots, edge_pictures, error_plots, painting, plots, run_report
    from hodge_pipeline.report.document import Picture

    paint_it = painting.painted

    def painted(title: str, caption: str, paint: Callable[[Any], None]) -> Picture:
        data = [cell.cell_contents for cell in paint.__closure__ or ()]
        return Picture(title, caption, made_once(folder, (title, data), lambda: paint_it(title, caption, paint).image))

    def seen(show: Callable[..., Any]) -> Callable[..., Any]:
        def shown(clouds: Any, *inputs: Any) -> Any:
            return made_once(folder, (show.__name__, clouds.sizes > 0, inputs), lambda: show(clouds, *inputs))

        return shown

    for module in (diagnosis_plots, edge_pictures, error_plots, plots):
        patch.setattr(module, "painted", painted)
    for show in (run_report.changed_most, run_report.four_sides):
        patch.setattr(run_report, show.__name__, seen(show))


def made_once(folder: Path, data: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """What was made of data of this kind first."""
    name = hashlib.sha256(repr((data[0], kind_of(data[1:]))).encode()).hexdigest()[:16]
    kept = folder / f"drawn-{name}.pickle"
    if not kept.exists():
        (draft := kept.with_suffix(f".{os.getpid()}")).write_bytes(pickle.dumps(make()))
        with suppress(FileExistsError):  # of another worker, which was first: its picture is in reports by now
            kept.hardlink_to(draft)
        draft.unlink()
    return pickle.loads(kept.read_bytes())


def kind_of(data: object) -> object:
    """What decides how data are drawn: which are there, none, one or many of them, finite and equal or not."""
    from hodge_pipeline.report.contents import Report

    if isinstance(data, Report):
        data = (data.pictures, data.scores, data.loops, data.has_metres, data.source.vertex)
    if isinstance(data, np.ndarray):
        shape = tuple(min(size, 2) for size in data.shape)
        known = data[np.isfinite(data)] if data.dtype.kind in "iuf" else data
        return shape, min(known.size, 2), known.size == data.size, bool(known.size and (known == known.flat[0]).all())
    if isinstance(data, (bool, str)):
        return bool(data)
    if isinstance(data, (list, tuple, dict)):
        named = dict(enumerate(data)) if isinstance(data, (list, tuple)) else data
        return sorted({repr((name if isinstance(name, str) else "", kind_of(one))) for name, one in named.items()})
    if is_dataclass(data):
        return [kind_of(getattr(data, one.name)) for one in fields(data)]
    return type(data).__name__


def texture_once(patch: pytest.MonkeyPatch) -> None:
    """Textures of a demo, which take longer than its few small images."""
    from hodge_pipeline.demo import room

    make = room.make_textures

    def make_textures(rng: np.random.Generator) -> object:
        state = str(rng.bit_generator.state)
        if state not in _textures:
            _textures[state] = make(rng)
        return _textures[state]

    patch.setattr(room, "make_textures", make_textures)
