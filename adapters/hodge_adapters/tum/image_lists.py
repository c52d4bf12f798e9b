"""Lists of stamped images: TUM's `rgb.txt` and `depth.txt`, and association files with both on one line."""

from __future__ import annotations

import filecmp
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.association import MISSING, clock_runs, nearest_in_runs, unpaired_doubts
from hodge_adapters.images import pixels
from hodge_adapters.images.frames import image_frame
from hodge_adapters.text_rows import Row, inside, listed, read_rows, to_floats
from hodge_adapters.trajectories.text import in_seconds, is_stamp, unit_of
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Floats, Frame, Ints
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

ASSOCIATION_FILES = ("associations.txt", "association.txt", "associate.txt", "associated.txt")
LONGEST_DELAY_S = 0.1
"""Between the images of one frame: stamps further apart are not of one clock."""
COLOUR_FOLDERS = ("rgb", "color", "colour", "image", "images", "mono", "gray", "grey")
_STAMP_NAME = re.compile(r"(\d+\.\d+|[1-9]\d{11,17}|[1-4]\d{18})\.(png|jpg|jpeg)", re.IGNORECASE)
"""Seconds with a fraction, or milliseconds to nanoseconds since 1970: no sequence has so many frames."""
_DEPTH_NAME = re.compile(r"depth", re.IGNORECASE)


@dataclass(frozen=True)
class StampedImages:
    """Depth images in order of their stamps, each with its colour image where there is one, and how many seconds later
    that was taken. `runs (N,)` number the parts, in the order of the file, between jumps of the clock back in time.
    `doubts` are told where many listed images are missing.
    """

    stamps_s: Floats
    depth: list[Path]
    colour: list[Path | None]
    colour_delays_s: Floats
    files: tuple[Path, ...]
    runs: Ints
    doubts: tuple[Note, ...] = ()

    @property
    def ids(self) -> list[int]:
        """The stamps where all are whole numbers (frame numbers), else the rows."""
        whole = np.equal(np.mod(self.stamps_s, 1), 0).all()
        return self.stamps_s.astype(np.int64).tolist() if whole else list(range(len(self.stamps_s)))

    def frames(self, camera: Camera, poses: Floats, every: int, notes: list[str], **options: Any) -> tuple[Frame, ...]:
        """Each `every`-th of them at its pose (N, 4, 4), with the `options` of `image_frame`."""
        colour_size = pixels.colour_size(self.colour, (camera.width, camera.height), notes)
        ids = self.ids
        return tuple(
            image_frame(
                ids[row],
                self.stamps_s[row],
                camera,
                self.depth[row],
                self.colour[row],
                world_from_cam=poses[row],
                colour_delay_s=float(self.colour_delays_s[row]),
                colour_size=colour_size,
                **options,
            )
            for row in range(0, len(ids), every)
        )


def find_association_file(folder: Path) -> Path | None:
    """The association file of a folder, by its usual names."""
    return next((folder / name for name in ASSOCIATION_FILES if (folder / name).is_file()), None)


def read_pairs(folder: Path, max_difference_s: float, notes: list[str]) -> StampedImages:
    """The images of a folder: by its association file if it has one, else by `depth.txt` and `rgb.txt`.

    Lines that cannot be used are left out and noted with their numbers; `SourceError` where nothing is left.
    """
    association = find_association_file(folder)
    found = _from_association(association, notes) if association else _from_lists(folder, max_difference_s, notes)
    there = [path.is_file() for path in found.depth]
    if not any(there):
        raise SourceError(f"{found.depth[0]}: not there, nor any other depth image listed: unpack the whole sequence")
    if not all(there):
        missing = [path.name for path, is_there in zip(found.depth, there, strict=True) if not is_there]
        notes.append(f"{len(missing)} depth images listed but not there left out: {listed(missing)}")
    colour = [path if path and path.is_file() else None for path in found.colour]
    lost = [path.name for path, kept in zip(found.colour, colour, strict=True) if path and not kept]
    if lost:
        notes.append(f"{len(lost)} colour images listed but not there: {listed(lost)}")
    rows = np.flatnonzero(there).tolist()
    counts = {"depth": (len(there) - len(rows), len(there)), "colour": (len(lost), sum(map(bool, found.colour)))}
    doubts = [
        Note("images missing", missing, f"{total} listed {kind} images")
        for kind, (missing, total) in counts.items()
        if missing > MISSING * total
    ]
    return StampedImages(
        found.stamps_s[rows],
        [found.depth[row] for row in rows],
        [colour[row] for row in rows],
        found.colour_delays_s[rows],
        found.files,
        found.runs[rows],
        (*doubts[:1], *found.doubts),
    )


def _from_lists(folder: Path, max_difference_s: float, notes: list[str]) -> StampedImages:
    depth_list, colour_list = folder / "depth.txt", folder / "rgb.txt"
    depth_stamps_s, depth, runs = _listed_or_named(depth_list, folder / "depth", notes)
    if not depth and depth_list.is_file():
        raise SourceError(f"{depth_list}: no line `stamp file` that can be used in it: write one for each depth image")
    if not depth:
        raise SourceError(
            f"{folder}: no depth.txt, no associations.txt and no depth images named by their stamps in it: give the "
            "folder that holds them, or unpack the whole sequence"
        )
    lists = tuple(path for path in (depth_list, colour_list) if path.is_file())
    colour_stamps_s, colour, colour_runs = _listed_or_named(
        colour_list, find_colour_folder(folder) or folder / "rgb", notes
    )
    if not colour and not colour_list.is_file():
        notes.append("no rgb.txt: frames have no colour")
        return StampedImages(depth_stamps_s, depth, [None] * len(depth), np.zeros(len(depth)), lists, runs)
    firsts, colour_firsts = _first_copies(depth, runs), _first_copies(colour, colour_runs)
    columns = np.full(len(depth), -1, np.int64)

    def pair(rows: Ints, among: Ints) -> None:
        found = nearest_in_runs(
            depth_stamps_s[rows], runs[rows], colour_stamps_s[among], colour_runs[among], max_difference_s
        )
        columns[rows] = np.append(among, -1)[found]

    new, new_colour = np.unique(firsts), np.unique(colour_firsts)
    pair(new, new_colour)
    pair(np.flatnonzero(columns < 0), np.setdiff1d(new_colour, columns))  # depth that is empty is alike, colour is not
    pair(new[columns[new] < 0], np.setdiff1d(np.arange(len(colour)), new_colour))  # rendered colour at rest is alike
    as_first = (columns < 0) & (columns[firsts] >= 0)
    columns = np.where(as_first, columns[firsts], columns)
    moments_s = np.where(as_first, depth_stamps_s[firsts], depth_stamps_s)
    alone = int((columns < 0).sum())
    if alone:
        notes.append(f"{alone} of {len(depth)} depth images have no colour image within {max_difference_s:g} s")
    if alone == len(depth) and colour:
        nearest_s = round(float(np.abs(colour_stamps_s - depth_stamps_s[alone // 2]).min()), 3)
        notes[-1] += f", the nearest is {nearest_s:g} s away: set max_difference_s, or are they of two clocks?"
    unpaired = len(np.setdiff1d(new_colour, columns))
    if unpaired:
        notes.append(f"{unpaired} of {len(colour)} colour images have no depth image within {max_difference_s:g} s")
    paired = [colour[column] if column >= 0 else None for column in columns.tolist()]
    delays_s = np.where(columns >= 0, np.append(colour_stamps_s, 0.0)[columns] - moments_s, 0.0)
    doubts = unpaired_doubts((columns >= 0).tolist()) if colour else ()
    return StampedImages(depth_stamps_s, depth, paired, delays_s, lists, runs, doubts)


def _first_copies(images: list[Path], runs: Ints) -> Ints:
    """The row (N,) of the image of which each is a copy, itself where it is none: of copies in sequence, as a recorder
    writes that sees no new image, the first alone has the stamp of its moment.
    """
    rows = np.arange(len(images))
    for row in range(1, len(images)):
        if runs[row] == runs[row - 1] and _are_copies(images[row - 1], images[row]):
            rows[row] = rows[row - 1]
    return rows


def _are_copies(one: Path, other: Path) -> bool:
    try:
        return filecmp.cmp(one, other, shallow=False)  # files of two sizes, as nearly all are, are not read
    except OSError:
        return False


def stamped_images(folder: Path) -> list[tuple[float, Path]]:
    """The images of a folder whose names are stamps, ascending: seconds with a fraction, as TUM names them, or whole
    milliseconds to nanoseconds since 1970; none where there are none.
    """
    try:
        return sorted((float(path.stem), path) for path in folder.iterdir() if _STAMP_NAME.fullmatch(path.name))
    except OSError:
        return []


def find_colour_folder(folder: Path) -> Path | None:
    """The folder of colour images, by its usual names."""
    return next((folder / name for name in COLOUR_FOLDERS if (folder / name).is_dir()), None)


def _listed_or_named(path: Path, images: Path, notes: list[str]) -> tuple[Floats, list[Path], Ints]:
    """Stamps, paths and runs by the list or, where it is missing, by the names of the images."""
    if path.is_file():
        return _read_list(path, notes)
    found = stamped_images(images)
    if found:
        notes.append(f"no {path.name}: the stamps of {len(found)} images are those of their names in {images.name}/")
    stamps_s = in_seconds(np.array([stamp for stamp, _ in found]), f"{images.name}/", notes)
    return stamps_s, [image for _, image in found], np.zeros(len(found), np.int64)


def _read_list(path: Path, notes: list[str]) -> tuple[Floats, list[Path], Ints]:
    """Stamps, ascending and unique in each run, paths and runs of a list `stamp file`, or of `number stamp.png`."""
    found: list[tuple[float, Path]] = []
    unreadable: list[int] = []
    outside: list[int] = []
    for row in read_rows(path):
        stamp_s = _stamp(row, 0)
        image = inside(path.parent, " ".join(row.fields[1:]).strip('"')) if len(row.fields) > 1 else None
        has_blanks = len(row.fields) > 2 and image is not None and image.is_file()
        if stamp_s is None or (len(row.fields) != 2 and not has_blanks):
            unreadable.append(row.line)
        elif image is None:
            outside.append(row.line)
        else:
            found.append((stamp_s, image))
    notes += _left_out(path.name, "`stamp file`", unreadable, outside)
    stamps = np.array([stamp for stamp, _ in found])
    are_numbers = len(found) > 0 and unit_of(stamps)[1] == 1 and not np.mod(stamps, 1).any()
    if are_numbers and all(_STAMP_NAME.fullmatch(image.name) for _, image in found):
        stamps = np.array([float(image.stem) for _, image in found])
        notes.append(f"{path.name}: it holds numbers, so stamps are those in the images' names")
    stamps_s, rows, runs = _in_order(stamps, path.name, notes)
    return stamps_s, [found[row][1] for row in rows], runs


def _from_association(path: Path, notes: list[str]) -> StampedImages:
    """Lines `stamp depth stamp rgb` or `stamp rgb stamp depth`: the order is seen from the names."""
    found: list[tuple[float, Path, Path, float]] = []
    unreadable: list[int] = []
    outside: list[int] = []
    rows = read_rows(path)
    depth_at = _depth_column(rows, path)
    for row in rows:
        if len(row.fields) != 4 or _stamp(row, 0) is None or _stamp(row, 2) is None:
            unreadable.append(row.line)
            continue
        stamp_s, colour_stamp_s = _stamp(row, depth_at - 1), _stamp(row, 3 - depth_at)
        depth, colour = (inside(path.parent, row.fields[column]) for column in (depth_at, 4 - depth_at))
        if stamp_s is None or colour_stamp_s is None or depth is None or colour is None:
            outside.append(row.line)
        else:
            found.append((stamp_s, depth, colour, colour_stamp_s))
    left_out = _left_out(path.name, "`stamp file stamp file`", unreadable, outside)
    notes += left_out
    if not found:
        why = f" ({'; '.join(left_out)})" if left_out else ""
        raise SourceError(f"{path}: no line `stamp file stamp file` that can be used in it{why}: mend or remove it")
    stamps_s, order, runs = _in_order(np.array([stamp for stamp, *_ in found]), path.name, notes)
    colour_stamps_s = in_seconds(np.array([found[row][3] for row in order]), path.name, [])
    delays_s = np.where(abs(colour_stamps_s - stamps_s) <= LONGEST_DELAY_S, colour_stamps_s - stamps_s, 0.0)
    return StampedImages(
        stamps_s, [found[row][1] for row in order], [found[row][2] for row in order], delays_s, (path,), runs
    )


def _left_out(name: str, expected: str, unreadable: list[int], outside: list[int]) -> list[str]:
    """A line for each reason why lines were left out."""
    reasons = ((f"that are not {expected}", unreadable), ("that name no file in the folder", outside))
    return [f"{name}: {counted(len(lines), 'line')} {why} left out: {listed(lines)}" for why, lines in reasons if lines]


def _depth_column(rows: list[Row], path: Path) -> int:
    """1 or 3: the column whose file names say depth in (nearly) all lines."""
    whole = [row for row in rows if len(row.fields) == 4]
    first = sum(bool(_DEPTH_NAME.search(row.fields[1])) for row in whole)
    second = sum(bool(_DEPTH_NAME.search(row.fields[3])) for row in whole)
    if whole and first == second:
        where = f"{path}:{whole[0].line}"
        raise SourceError(f"{where}: neither or both file names say depth: keep depth images in a folder named depth")
    return 1 if first > second else 3


def _stamp(row: Row, column: int) -> float | None:
    values = to_floats(row.fields[column : column + 1])
    return values[0] if values and is_stamp(values[0]) else None


def _in_order(stamps: Floats, name: str, notes: list[str]) -> tuple[Floats, list[int], Ints]:
    """Stamps in seconds, ascending and unique in each run, their rows and runs; of equal ones the first is kept."""
    stamps_s = in_seconds(stamps, name, notes)
    runs = clock_runs(stamps_s)
    order = np.lexsort((stamps_s, runs))
    again = np.flatnonzero((np.diff(stamps_s[order]) == 0) & (np.diff(runs[order]) == 0)) + 1
    order = np.delete(order, again)
    if len(again):
        notes.append(f"{name}: {counted(len(again), 'line')} with the stamp of an earlier one left out")
    if runs.any():
        places = listed((np.flatnonzero(np.diff(runs)) + 1).tolist())
        notes.append(f"{name}: the clock jumps back before image {places}: images are taken in the order of the file")
    elif (np.diff(stamps_s) < 0).any():
        notes.append(f"{name}: lines were not in order of time: sorted")
    return stamps_s[order], order.tolist(), runs[order]
