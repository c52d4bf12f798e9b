"""COLMAP models: posed images, depth where there is some, and edges measured anew from what images share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.colmap.cameras import (
    UNDISTORTED,
    pinhole_camera,
    read_sensor_depth,
    read_stereo_depth,
    read_undistorted_colour,
)
from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.database import database_pairs
from hodge_adapters.colmap.depth import depth_map_size, sensor_depth, stereo_depth
from hodge_adapters.colmap.edges import Pair, covisible_pairs, measured_graph
from hodge_adapters.colmap.files import (
    by_report,
    find_database,
    find_folder,
    find_images,
    find_models,
    incomplete_models,
    largest_model,
    no_model,
    part_of_model,
    unread_text,
)
from hodge_adapters.colmap.records import CameraRecord, ImageRecord, Model
from hodge_adapters.colmap.scale import metres_per_unit
from hodge_adapters.images import pixels
from hodge_adapters.text_rows import inside, listed
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import EncodedImage, Floats, Frame, ImageFile, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted

STEREO_FOLDERS = ("stereo/depth_maps", "dense/stereo/depth_maps", "dense/0/stereo/depth_maps")
SENSOR_FOLDERS = ("depth", "depths", "depth_images")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ColmapReader:
    """Reads a COLMAP model, binary or text, with or without rigs, and what lies beside it.

    In a model with rigs an image has the pose of its rig's frame, moved to its own camera.
    """

    images: str = Field("auto", description="folder of the colour images; auto: images/ and the like; none")
    depth: str = Field(
        "auto",
        description="folder of sensor depth images named as the colour images (or depth for color), or of COLMAP's "
        "depth maps; auto: stereo/depth_maps, depth/, else beside the colour images; none",
    )
    depth_scale: float = Field(1000.0, gt=0, description="stored units per metre of sensor depth; most sensors: mm")
    no_depth: tuple[int, ...] = Field((0, 65535), description="stored values of sensor depth that mean none")
    scale: float | Literal["auto"] = Field(
        "auto",
        description="metres in one unit of the model, whose scale is arbitrary; auto: by sensor depth at the points, "
        "1 without any",
    )
    edges: Literal["auto", "none", "covisibility", "database"] = Field(
        "auto",
        description="relative poses estimated anew from shared points or from the database's matches; auto: none where "
        "frames have depth to be registered, else database.db if it is there, else covisibility",
    )
    min_shared: int = Field(
        30, ge=8, description="points or matches that a pair must share; the paper asks for 50 of SIFT"
    )
    max_edges_per_image: int = Field(10, ge=1, description="pairs for an image, those with most shared points first")
    tracks: bool = Field(True, description="false: cameras and poses alone, for models whose tracks are broken")
    seed: int = Field(0, ge=0, description="of RANSAC")
    every: int = Field(1, ge=1, description="take every n-th image")

    def sniff(self, path: Path) -> Sniff:
        """Sure of a folder with cameras and images in one of COLMAP's places."""
        try:
            models = find_models(Path(path))
        except OSError:
            return Sniff(0.0, "not a folder that can be read")
        if not models:
            return Sniff(0.0, "no cameras.bin and images.bin, nor .txt", part_of_model(Path(path)))
        return Sniff(0.9, f"cameras and images in {models[0].name or models[0]}")

    def open(self, path: Path) -> Source:
        """Images in natural order of their names as frames: id is the name, stamp the row, sequence the folder.

        Frames have a pinhole camera; depth and colour of a distorting one are undistorted when read.
        """
        path = Path(path)
        folders = find_models(path)
        if not folders:
            raise no_model(path)
        folder, several = largest_model(folders)
        source = self.source_of(path, folder, self._load(folder))
        told = (
            [f"{several}: {folder.name} is taken, which has most; `hodge refine colmap` joins them"] if several else []
        )
        told += [f"left out: {lack}" for lack in incomplete_models(path, folders)]
        return replace(source, notes=(*told, *source.notes))

    def _load(self, folder: Path) -> Model:
        """The model; where its tracks alone are broken the error says how to do without."""
        try:
            return read_model(folder, self.tracks)[1]
        except SourceError as error:
            if not self.tracks:
                raise
            try:
                read_model(folder, False)
            except SourceError:
                raise error from None
            raise SourceError(f"{error}, or set tracks=false to take its poses alone") from error

    def source_of(self, path: Path, folder: Path, model: Model) -> Source:
        """The source that a model of this folder is, with what lies beside it; `path` is what the user gave."""
        notes = [*unread_text(folder), *model.notes]
        colour_folder = find_images(folder, self.images)
        if self.images == "auto":
            notes += by_report(folder, colour_folder)
        depths = self._depths(folder, colour_folder, model)
        readable = {row: file for row, file in enumerate(depths) if file}
        if self.depth != "none" and 0 < len(readable) < len(depths):
            notes.append(f"{len(depths) - len(readable)} of {len(depths)} images have no depth")
        scale = self._scale(model, depths, notes)
        poses = se3.rescaled(model.world_from_cam, scale)
        sizes = _sizes(model, depths)
        try:
            frames = tuple(
                self._frame(
                    row, image, model.cameras[image.camera_id], poses[row], colour_folder, depths[row], sizes, scale
                )
                for row, image in enumerate(model.images)
            )
        except SourceError as error:
            raise SourceError(f"{folder}: {error}") from error
        lost = [frame.frame_id for frame in frames if frame.read_colour is None]
        if lost:
            advice = "" if colour_folder else ": images=FOLDER names where they are"
            notes.append(f"{len(lost)} of {len(frames)} images are not there as files: {listed(lost)}{advice}")
        graph, database = self._graph(folder, model, bool(readable), scale, notes)
        files = (*model.files, *database, *readable.values())
        return Source(
            name=path.resolve().name,
            path=path,
            frames=frames[:: self.every],
            trajectory=Trajectory(np.arange(len(poses), dtype=float), poses, has_stamps=False),
            graph=graph,
            notes=tuple(notes),
            files=files,
            in_metres=self.scale != "auto" or scale != 1.0,  # which says that no depth told
        )

    def _depths(self, folder: Path, colour: Path | None, model: Model) -> list[Path | None]:
        """The depth file of each image."""
        stereo = find_folder(folder, self.depth, STEREO_FOLDERS)
        if stereo:
            found = [stereo_depth(stereo, image.name) for image in model.images]
            if any(found):
                return found
        sensor = find_folder(folder, self.depth, SENSOR_FOLDERS) or (colour if self.depth == "auto" else None)
        if sensor is None:
            return [None] * len(model.images)
        found = [sensor_depth(sensor, image.name, colour) for image in model.images]
        if self.depth != "auto" and not any(found):
            raise SourceError(f"{sensor}: no depth of {model.images[0].name!r} or another image: name the PNGs alike")
        return found

    def _scale(self, model: Model, depths: list[Path | None], notes: list[str]) -> float:
        if self.scale != "auto":
            return self.scale
        sensors = {row: file for row, file in enumerate(depths) if file and file.suffix == ".png"}
        if not sensors:
            return 1.0
        return metres_per_unit(model, sensors, self.depth_scale, self.no_depth, notes)

    def _frame(
        self,
        row: int,
        image: ImageRecord,
        record: CameraRecord,
        pose: Floats,
        colour_folder: Path | None,
        depth: Path | None,
        sizes: dict[int, tuple[int, int]],
        scale: float,
    ) -> Frame:
        size = sizes[row]
        camera = pinhole_camera(record, size)
        colour = inside(colour_folder, image.name) if colour_folder else None
        if colour is not None and not colour.is_file():
            colour = None
        plain = record.model in UNDISTORTED
        read = None
        if depth and depth.suffix == ".png":
            read = partial(
                read_sensor_depth,
                depth,
                record=record,
                size=size,
                units_per_metre=self.depth_scale,
                no_depth=self.no_depth,
            )
        elif depth:
            read = partial(read_stereo_depth, depth, record=record, size=size, metres_per_unit=scale)
        whole_colour = colour if plain and size == (record.width, record.height) else None
        return Frame(
            frame_id=image.name,
            stamp_s=float(row),
            camera=camera,
            read_depth=read,
            read_colour=partial(read_undistorted_colour, colour, record=record, size=size) if colour else None,
            encoded_depth=_encoded_depth(depth, self.depth_scale) if plain else None,
            encoded_colour=partial(pixels.encoded, whole_colour) if whole_colour else None,
            image=ImageFile(colour, record.width, record.height, record.model, record.params) if colour else None,
            world_from_cam=pose,
            sequence=os.path.dirname(image.name),  # cameras of a rig have a folder each
        )

    def _graph(
        self, folder: Path, model: Model, has_depth: bool, scale: float, notes: list[str]
    ) -> tuple[ViewGraph | None, tuple[Path, ...]]:
        """The measured graph in metres, and the database that it rests on."""
        database = find_database(folder)
        kind = self.edges
        if kind == "auto":
            kind = "none" if has_depth or not self.tracks else "database" if database else "covisibility"
        if kind == "none":
            return None, ()
        pairs: Iterator[Pair] = covisible_pairs(model, self.min_shared, self.max_edges_per_image)
        if kind == "database":
            if database is None:
                raise SourceError(
                    f"{folder}: no database.db beside or above it: put it there, or set edges=covisibility"
                )
            notes += by_report(folder, database)
            pairs = database_pairs(database, model, self.min_shared, notes)
        graph = measured_graph(model, pairs, self.min_shared // 2, self.seed, notes)
        notes.append(
            f"{counted(graph.edge_count, 'edge')} estimated anew ({kind}); their scale is that of the model's points"
        )
        graph = replace(
            graph,
            i_from_j=se3.rescaled(graph.i_from_j, scale),
            information=se3.rescaled_information(graph.information, scale),
        )
        return graph, (database,) if database and kind == "database" else ()


def _encoded_depth(depth: Path | None, units_per_metre: float) -> partial[EncodedImage] | None:
    if depth is None or depth.suffix != ".png":
        return None
    return partial(pixels.encoded, depth, units_per_metre=units_per_metre)


def _sizes(model: Model, depths: list[Path | None]) -> dict[int, tuple[int, int]]:
    """The (width, height) of each image's frame: that of its camera's first depth image, else the camera's."""
    by_camera: dict[int, tuple[int, int]] = {}
    sizes = {}
    for row, (image, depth) in enumerate(zip(model.images, depths, strict=True)):
        record = model.cameras[image.camera_id]
        if depth and image.camera_id not in by_camera:
            read = pixels.image_size if depth.suffix == ".png" else depth_map_size
            by_camera[image.camera_id] = read(depth)
        sizes[row] = by_camera.get(image.camera_id, (record.width, record.height))
    return sizes
