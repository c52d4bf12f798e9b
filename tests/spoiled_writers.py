"""Writers, rewriters and readers of models each of which breaks one promise of its contract."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.trajectories.rewriting import TumRewriter
from hodge_adapters.trajectories.text import TumWriter
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Source
from spoiled_stages import OFF, counted


@dataclass(frozen=True)
class Writer:
    how: str

    def write(self, path: Path, source: Source) -> None:
        match self.how:
            case "nothing":
                return
            case "leftovers":
                (path.parent / "draft").write_text("x")
            case "clock":
                path.write_text(str(counted()))
                return
            case "appends":
                with path.open("a") as out:
                    out.write("a line\n")
                return
            case "raw":
                path.write_text("a line\n")
                return
            case "shifted":
                assert source.trajectory is not None
                poses = OFF @ source.trajectory.world_from_cam
                source = replace(source, trajectory=replace(source.trajectory, world_from_cam=poses))
            case "anonymous" if source.trajectory is None:
                raise SourceError("has no poses")
        TumWriter().write(path, source)


@dataclass(frozen=True)
class Rewriter:
    how: str

    def rewrite(self, folder: Path, original: Path, trajectory: Any) -> Path:
        if self.how == "ignores":
            return self.copy(folder, original)
        if self.how == "in place":
            original.write_text(original.read_text() + "\n")
        path = TumRewriter().rewrite(folder, original, trajectory)
        return path.rename(folder / "new.tum") if self.how == "name" else path

    def copy(self, folder: Path, original: Path) -> Path:
        path = TumRewriter().copy(folder, original)
        if self.how == "converts":
            path.write_text(path.read_text().replace("0", "0 "))
        return path


class Model:
    """A COLMAP model with one method spoiled."""

    def __init__(self, inner: Any, how: str) -> None:
        self._inner, self._how = inner, how

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    @property
    def world_from_body(self) -> Floats:
        poses: Floats = self._inner.world_from_body
        return poses @ OFF if self._how == "carried" else poses

    def scaled(self, factor: float, motion: Any = None) -> Any:
        return self._inner.scaled(1.0 if self._how == "one scale" else factor, motion)

    def thinned(self, most_seen: int) -> Any:
        return self._inner.thinned(1) if self._how == "thins all" else self._inner.thinned(most_seen)

    def moved(self, poses: Floats) -> Any:
        return self._inner if self._how == "stays" else self._inner.moved(poses)

    def adjusted(self, **options: Any) -> Any:
        found = self._inner.adjusted(**options)
        return replace(found, has_converged="perhaps") if self._how == "untold" else found

    def measured(self) -> Any:
        graph, notes = self._inner.measured()
        return (replace(graph, i_from_j=1.1 * graph.i_from_j), notes) if self._how == "sheared" else (graph, notes)

    def seen_points(self) -> Any:
        return list(self._inner.seen_points())[1:] if self._how == "one cloud less" else self._inner.seen_points()

    def read_back(self, folder: Path, notes: tuple[str, ...]) -> Any:
        return self._inner.read_back(folder, () if self._how == "no notes" else notes)


@dataclass(frozen=True)
class Models:
    how: str

    def open_models(self, source: Any) -> Any:
        if self.how == "takes anything" and not source.exists():
            return []
        return [Model(model, self.how) for model in ColmapModels().open_models(source)]

    def join(self, models: Any) -> Any:
        return [(model, [row]) for row, model in enumerate(models)]
