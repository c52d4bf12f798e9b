"""COLMAP models to be refined: found, read with their depth and database, and joined where one scene fell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.colmap.beside import DepthOptions, EdgeOptions, PriorOptions
from hodge_adapters.colmap.bundle import Refine
from hodge_adapters.colmap.content import checked_content, read_model
from hodge_adapters.colmap.database import database_names, has_verified_pairs
from hodge_adapters.colmap.depth import sensor_depth
from hodge_adapters.colmap.files import (
    by_report,
    find_database,
    find_models,
    incomplete_models,
    largest_model,
    model_ending,
    no_model,
)
from hodge_adapters.colmap.priors import database_priors, table_priors
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.colmap.records import Model
from hodge_adapters.colmap.scale import other_camera_note
from hodge_adapters.colmap.ties import similarity, tie_points
from hodge_adapters.colmap.tracked import ColmapModel
from hodge_adapters.colmap.union import united
from hodge_adapters.images import pixels
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Frame
from hodge_pipeline.types.text import counted

HELD = "intrinsics are held: --refine focal or all adjusts them too"
REFINED = {
    "rig": "where rigs hold their cameras is refined",
    "focal": "intrinsics are refined: focal",
    "all": "intrinsics are refined: all",
}
COVISIBILITY = "edges come from the points that images share"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ColmapModels:
    """A COLMAP model, or all that a reconstruction fell into, binary or text, with or without rigs."""

    database: str = Field("auto", description="COLMAP's database; auto: database.db beside or above the model; none")
    images: str = Field("auto", description="folder of the colour images; auto: images/ and the like; none")
    depth: str = Field(
        "none", description="folder of sensor depth named as the colour images (or depth for color); none: no depth"
    )
    depth_scale: float = Field(1000.0, gt=0, description="stored units per metre of sensor depth; most sensors: mm")
    depth_camera: tuple[float, float, float, float] | None = Field(
        None, description="fx fy cx cy of the depth images; none: their pixels are those of the colour images"
    )
    no_depth: tuple[int, ...] = Field((0, 65535), description="stored values of sensor depth that mean none")
    min_shared: int = Field(30, ge=8, description="points or matches that a pair must share to become an edge")
    max_edges_per_image: int = Field(
        20, ge=1, description="pairs for an image where there is no database, those with most shared points first"
    )
    refine: Refine = Field(
        "none",
        description="refined beside poses: focal lengths, all intrinsics, where a rig holds its cameras, or none",
    )
    positions: str = Field(
        "none",
        description="known positions of images, whose world the result is then in: database (its pose priors: GPS, "
        "gravity), or a table of name and e,n,u or lat,lon,alt; none",
    )
    position_sigma_m: float = Field(1.0, gt=0, description="metres: sigma of positions that state none")
    seed: int = Field(0, ge=0, description="of RANSAC")

    def open_models(self, source: Path | Sequence[pycolmap.Reconstruction]) -> Sequence[ColmapModel]:
        """The model of a folder; of a folder with `0`, `1`, … all of them; or of pycolmap. Raises `SourceError`."""
        if not isinstance(source, (str, Path)):
            return [self._of_memory(number, model) for number, model in enumerate(source)]
        folders = find_models(Path(source))
        if not folders:
            raise no_model(Path(source))
        largest, several = largest_model(folders)
        told = [f"{several}: those that tie are joined, the report shows the largest result"] if several else []
        told += [f"left out: {lack}" for lack in incomplete_models(Path(source), folders)]
        models = [self._open(folder, *read_model(folder)) for folder in folders]
        return [
            replace(model, notes=(*told, *model.notes)) if folder == largest else model
            for folder, model in zip(folders, models, strict=True)
        ]

    def _of_memory(self, number: int, model: pycolmap.Reconstruction) -> ColmapModel:
        """A copy of a model of pycolmap's, beside which nothing lies."""
        nowhere = Path(f"model {number}")
        images, database = ("none" if option == "auto" else option for option in (self.images, self.database))
        alone = replace(self, images=images, database=database)
        copy = pycolmap.Reconstruction(model)
        return alone._open(nowhere, copy, checked_content(copy, nowhere))

    def join(self, models: Sequence[ColmapModel]) -> Sequence[tuple[ColmapModel, Sequence[int]]]:
        """The largest model takes in, one by one, those that enough tied points place in it."""
        left = sorted(range(len(models)), key=lambda row: -models[row].quality.images)
        out = []
        while left:
            rows, at = [left.pop(0)], 0
            whole = models[rows[0]]
            while at < len(left):
                joined = _joined(whole, models[left[at]])
                if joined is None:
                    at += 1
                else:
                    rows.append(left.pop(at))
                    whole, at = joined, 0
            out.append((whole, rows))
        return out

    def _open(self, folder: Path, reconstruction: pycolmap.Reconstruction, content: Model) -> ColmapModel:
        sensor = self._sensor(folder)
        plain = ColmapReader(edges="none", scale=1.0)  # type: ignore[call-arg] # the plugin reads Field(1, …) as required
        depth_of = "none" if sensor is None else str(sensor.absolute())
        source = replace(
            plain, images=self.images, depth=depth_of, depth_scale=self.depth_scale, no_depth=self.no_depth
        ).source_of(folder, folder, content)
        notes = [
            *source.notes,
            *_unposed(reconstruction),
            HELD if self.refine == "none" else REFINED[self.refine],
        ]
        frames = {str(frame.frame_id): frame for frame in source.frames}
        depth = self._depth(sensor, frames)
        database = self._database(folder, frames, notes)
        model = ColmapModel(
            name=str(folder),
            reconstruction=reconstruction,
            all_frames={name: self._with_depth(frame, depth.files.get(name)) for name, frame in frames.items()},
            depth=depth,
            edges=EdgeOptions(database, self.min_shared, self.max_edges_per_image, self.seed),
            text=model_ending(folder) == ".txt",
            files=content.files,
            refine=self.refine,
            known=self._known(database, notes),
            content=content,
            notes=tuple(notes),
        )
        return self._with_camera_note(model)

    def _with_camera_note(self, model: ColmapModel) -> ColmapModel:
        names = [image.name for image in model.records.images]
        sensors = {row: model.depth.files[name] for row, name in enumerate(names) if name in model.depth.files}
        if not sensors or self.depth_camera is not None:
            return model
        note = other_camera_note(model.records, sensors, self.depth_scale, self.no_depth)
        return model if note is None else replace(model, notes=(*model.notes, note))

    def _sensor(self, folder: Path) -> Path | None:
        if self.depth == "none":
            return None
        found = next((place for place in (Path(self.depth), folder / self.depth) if place.is_dir()), None)
        if found is None:
            raise SourceError(f"{self.depth}: no such folder of depth images: give --depth one that is there")
        return found

    def _depth(self, sensor: Path | None, frames: dict[str, Frame]) -> DepthOptions:
        found = {name: sensor_depth(sensor, name, None) for name in frames} if sensor else {}
        files = {name: path for name, path in found.items() if path}
        return DepthOptions(files, self.depth_scale, self.no_depth, self.depth_camera)

    def _database(self, folder: Path, frames: dict[str, Frame], notes: list[str]) -> Path | None:
        """The database, where it has images of the model."""
        if self.database == "none":
            return None
        if self.database == "auto":
            found = find_database(folder)
            notes += by_report(folder, found)
        else:
            found = next((path for path in (Path(self.database), folder / self.database) if path.is_file()), None)
            if found is None:
                raise SourceError(f"{self.database}: no such database: give --database one that is there, or none")
        if found is None:
            notes.append(f"no database.db beside or above the model: {COVISIBILITY}")
        elif not database_names(found) & frames.keys():
            notes.append(f"{found}: holds none of the model's images: {COVISIBILITY}")
            return None
        elif not has_verified_pairs(found):
            notes.append(f"{found}: has no two_view_geometries, as databases of old: {COVISIBILITY}")
            return None
        return found

    def _known(self, database: Path | None, notes: list[str]) -> PriorOptions:
        """What is known of images beside their pixels."""
        if self.positions == "none":
            count = len(database_priors(database)) if database else 0
            if count:
                notes.append(
                    f"the database has pose priors of {counted(count, 'image')}: --positions database places the model"
                )
            return PriorOptions()
        if self.positions == "database":
            if database is None:
                raise SourceError("--positions database: there is no database: give --database, or a table")
            return PriorOptions(database_priors(database), None, self.position_sigma_m)
        path = Path(self.positions)
        return PriorOptions(table_priors(path, notes), path, self.position_sigma_m)

    def _with_depth(self, frame: Frame, depth: Path | None) -> Frame:
        """The frame in the camera of its depth, where that is another one than the colour's."""
        if depth is None or self.depth_camera is None:
            return frame
        read = partial(pixels.read_depth, depth, units_per_metre=self.depth_scale, no_depth=self.no_depth)
        return replace(frame, camera=Camera(*pixels.image_size(depth), *self.depth_camera), read_depth=read)


def _unposed(reconstruction: pycolmap.Reconstruction) -> list[str]:
    unposed = reconstruction.num_images() - reconstruction.num_reg_images()
    return [f"{counted(unposed, 'image')} of the model without a pose: left without"] if unposed else []


def _joined(whole: ColmapModel, other: ColmapModel) -> ColmapModel | None:
    ties = tie_points(whole.records, other.records, whole.edges.database)
    found = similarity(whole.reconstruction, other.reconstruction, ties)
    if found is None:
        return None
    whole_from_other, agreeing = found
    moved = pycolmap.Reconstruction(other.reconstruction)
    moved.transform(whole_from_other)
    points = f"{agreeing} of {len(ties)} points in both"
    note = f"{other.name} joined to {whole.name} by {points}, scale {whole_from_other.scale:.4g}"
    depth = replace(whole.depth, files={**other.depth.files, **whole.depth.files})
    known = replace(whole.known, images={**other.known.images, **whole.known.images})
    return replace(
        whole,
        reconstruction=united(whole.reconstruction, moved),
        all_frames={**other.all_frames, **whole.all_frames},
        depth=depth,
        known=known,
        files=(),
        notes=(*whole.notes, *(line for line in other.notes if line not in whole.notes), note),
        tracks=None,
        content=None,
    ).merged()
