"""The files of a recording: an MCAP file, a ROS 1 or an SQLite bag, or the folder of a split ROS 2 bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from hodge_adapters.mcap.records import MAGIC
from hodge_adapters.mcap.ros1_bag import MAGIC as BAG_MAGIC
from hodge_adapters.sqlite_file import MAGIC as SQLITE_MAGIC
from hodge_adapters.text_rows import inside, listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types.input_files import beginning, read_input_text
from hodge_pipeline.types.text import counted

METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 1 << 18
"""Of a bag of a thousand files; it takes ten seconds to parse."""
SUFFIXES = (".mcap", ".db3", ".bag")
KINDS = {MAGIC: "an MCAP file", BAG_MAGIC: "a ROS 1 bag"}


@dataclass(frozen=True)
class Listing:
    """The files in the order of recording, and all that identify the input (`metadata.yaml` too)."""

    logs: tuple[Path, ...]
    all: tuple[Path, ...]


def sniff_recording(path: Path) -> Sniff:
    """How sure it is that a path is a recording, or a folder of some."""
    try:
        if path.is_file():
            begins = beginning(path, len(SQLITE_MAGIC))
            for magic, kind in KINDS.items():
                if begins.startswith(magic):
                    return Sniff(1.0, f"starts as {kind}")
            if begins == SQLITE_MAGIC and path.suffix == ".db3":
                return Sniff(0.9, "an SQLite file called .db3, as ROS 2 bags are")
            return Sniff(0.0, "does not start as an MCAP file", _other_recording(path, begins))
        if path.is_dir() and (there := _there(path)):
            is_bag = (path / METADATA).is_file()
            return Sniff(0.9, METADATA) if is_bag else Sniff(0.7, f"a folder with {there[0].suffix} files")
    except OSError:
        return Sniff(0.0, "cannot be read")
    advice = f"no .mcap or .db3 file in this bag: {_remedy(path)}" if (path / METADATA).is_file() else ""
    return Sniff(0.0, "neither an MCAP file nor a folder with one", advice)


def find_files(path: Path, notes: list[str]) -> Listing:
    """The files to read; raises `SourceError` where there is none."""
    if path.is_file():
        return Listing((path,), (path,))
    if not path.is_dir():
        raise SourceError(f"{path}: not there: give an .mcap, .db3 or .bag file, or the folder of a bag")
    there = _there(path)
    metadata = path / METADATA
    if not metadata.is_file():
        if not there:
            raise SourceError(f"{path}: a folder without an .mcap, .db3 or .bag file: {_remedy(path)}")
        return Listing(tuple(there), tuple(there))
    listed_files = _listed(metadata, notes)
    absent = [file.name for file in listed_files if not file.is_file()]
    if absent:
        notes.append(f"{METADATA}: {counted(len(absent), 'file')} not there left out: {listed(absent)}")
    found = [file for file in listed_files if file.is_file() and file.suffix in SUFFIXES]
    extra = [file for file in there if file not in found]
    if extra and found:
        names = listed([file.name for file in extra])
        notes.append(f"{counted(len(extra), 'file')} that {METADATA} does not list read as well: {names}")
    found += extra
    if not found:
        raise SourceError(f"{path}: {METADATA} lists no .mcap or .db3 file that is there: {_remedy(path)}")
    return Listing(tuple(found), (metadata, *found))


def _there(path: Path) -> list[Path]:
    """The recordings in a folder by name, of the first kind that it has."""
    return next((found for suffix in SUFFIXES if (found := sorted(path.glob(f"*{suffix}")))), [])


def _listed(metadata: Path, notes: list[str]) -> list[Path]:
    """The files that a bag's metadata lists, none where it cannot be read."""
    try:
        content = YAML(typ="safe", pure=True).load(read_input_text(metadata, MAX_METADATA_BYTES, errors="replace"))
        names = content["rosbag2_bagfile_information"]["relative_file_paths"]
        paths = [inside(metadata.parent, str(name)) for name in names]
    except (OSError, YAMLError, KeyError, TypeError, ValueError, AttributeError, RecursionError):
        notes.append(f"{METADATA} cannot be read: every file of the recording in the folder is taken, by name")
        return []
    if None in paths:
        notes.append(f"{METADATA}: {counted(paths.count(None), 'file')} outside of the folder left out")
    return [path for path in dict.fromkeys(paths) if path]


def _other_recording(path: Path, begins: bytes) -> str:
    """What to do with a file that is nearly a recording, empty for any other."""
    if path.name == METADATA and _there(path.parent):
        return f"the list of a bag's files: give its folder {path.parent}"
    if begins.startswith(b"#ROSBAG"):
        return "a ROS 1 bag of another format than 2.0: `rosbag migrate` or `rosbag reindex` makes one of it"
    packed = ".mcap." in path.name or path.name.endswith((".tar", ".tar.gz", ".tar.xz", ".tar.zst", ".zip", ".7z"))
    return "packed: unpack it first" if packed else ""


def _remedy(path: Path) -> str:
    packed = [file.name for pattern in ("*.zstd", "*.zst", "*.lz4") for file in path.glob(pattern)]
    if packed:
        return f"unpack {listed(sorted(packed))} first"
    return "give the folder that a recording was written to"
