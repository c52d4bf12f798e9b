"""The .mcap files of a recording: one file, or the folder of a split ROS 2 bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from hodge_adapters.mcap_records import MAGIC
from hodge_adapters.text_rows import inside, listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types.input_files import beginning, read_input_text

METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 1 << 18
"""Of a bag of a thousand files; it takes ten seconds to parse."""
SQLITE_REMEDY = "convert it with `ros2 bag convert` to storage mcap"


@dataclass(frozen=True)
class Listing:
    """The files in the order of recording, and all that identify the input (`metadata.yaml` too)."""

    mcap: tuple[Path, ...]
    all: tuple[Path, ...]


def sniff_recording(path: Path) -> Sniff:
    """How sure it is that a path is an MCAP file, or a folder of some."""
    try:
        if path.is_file():
            if beginning(path, len(MAGIC)) == MAGIC:
                return Sniff(1.0, "starts as an MCAP file")
            return Sniff(0.0, "does not start as an MCAP file", _other_recording(path))
        if path.is_dir() and any(path.glob("*.mcap")):
            return Sniff(0.9, METADATA) if (path / METADATA).is_file() else Sniff(0.7, "a folder with .mcap files")
    except OSError:
        return Sniff(0.0, "cannot be read")
    advice = f"no .mcap file in this bag: {_remedy(path)}" if (path / METADATA).is_file() else ""
    return Sniff(0.0, "neither an MCAP file nor a folder with one", advice)


def find_files(path: Path, notes: list[str]) -> Listing:
    """The files to read; raises `SourceError` where there is none."""
    if path.is_file():
        return Listing((path,), (path,))
    if not path.is_dir():
        raise SourceError(f"{path}: not there: give an .mcap file, or the folder of a bag")
    there = sorted(path.glob("*.mcap"))
    metadata = path / METADATA
    if not metadata.is_file():
        if not there:
            raise SourceError(f"{path}: a folder without an .mcap file: {_remedy(path)}")
        return Listing(tuple(there), tuple(there))
    listed_files = _listed(metadata, notes)
    absent = [file.name for file in listed_files if not file.is_file()]
    if absent:
        notes.append(f"{METADATA}: {len(absent)} files that are not there left out: {listed(absent)}")
    found = [file for file in listed_files if file.is_file() and file.suffix == ".mcap"]
    extra = [file for file in there if file not in found]
    if extra and found:
        notes.append(f"{len(extra)} files that {METADATA} does not list read as well: {_names(extra)}")
    found += extra
    if not found:
        raise SourceError(f"{path}: {METADATA} lists no .mcap file that is there: {_remedy(path)}")
    return Listing(tuple(found), (metadata, *found))


def _listed(metadata: Path, notes: list[str]) -> list[Path]:
    """The files that a bag's metadata lists, none where it cannot be read."""
    try:
        content = YAML(typ="safe", pure=True).load(read_input_text(metadata, MAX_METADATA_BYTES, errors="replace"))
        names = content["rosbag2_bagfile_information"]["relative_file_paths"]
        paths = [inside(metadata.parent, str(name)) for name in names]
    except (OSError, YAMLError, KeyError, TypeError, ValueError, AttributeError, RecursionError):
        notes.append(f"{METADATA} cannot be read: every .mcap file of the folder is taken, by name")
        return []
    if None in paths:
        notes.append(f"{METADATA}: {paths.count(None)} files outside of the folder left out")
    return [path for path in dict.fromkeys(paths) if path]


def _other_recording(path: Path) -> str:
    """What to do with a file that is nearly a recording, empty for any other."""
    if path.name == METADATA and any(path.parent.glob("*.mcap")):
        return f"the list of a bag's files: give its folder {path.parent}"
    if path.suffix == ".bag":
        return "a ROS 1 bag: convert it with `mcap convert` and give the .mcap file"
    if path.suffix == ".db3":
        return f"an SQLite bag: {SQLITE_REMEDY}"
    packed = ".mcap." in path.name or path.name.endswith((".tar", ".tar.gz", ".tar.xz", ".tar.zst", ".zip", ".7z"))
    return "packed: unpack it first" if packed else ""


def _names(files: list[Path]) -> str:
    return listed([file.name for file in files])


def _remedy(path: Path) -> str:
    packed = [file.name for pattern in ("*.mcap.zstd", "*.mcap.zst", "*.mcap.lz4") for file in path.glob(pattern)]
    if packed:
        return f"unpack {listed(sorted(packed))} first"
    if any(path.glob("*.db3")):
        return SQLITE_REMEDY
    return "give the folder that a recording was written to"
