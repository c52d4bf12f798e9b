"""Names of all entities, timelines and part files of a recording; `docs/recordings.md` explains them."""

from __future__ import annotations

import re

STORY = "story"
"""The timeline that all data with a time share: seconds of a film in which each stage has its own slot."""
FRAME = "frame"
ITERATION = "iteration"
STAGE = "stage"
"""Counts the slots of the story: 0 is the capture with its odometry, k outer round k, then the fused model."""
TIME = "time"

SLOT_S = 10.0
"""Length of one stage's slot on the story timeline."""

WORLD = "/world"
MODEL = "/world/model"
CAMERA = "/world/camera"
CLOUD = "/world/camera/cloud"
PINHOLE = "/world/camera/image"
COLOUR = "/world/camera/image/colour"
DEPTH = "/world/camera/image/depth"
TRAJECTORIES = "/world/trajectories"
EDGES = "/world/edges"
VERDICTS = "/world/verdicts"
TRIANGLES = "/world/curl/triangles"
LOOPS = "/world/curl/loops"
VERTICES = "/world/vertices"
COMPLEX = "/world/complex"
GROWTH = "/world/growth"
PAIRS = "/pairs"
FILM = "/world/film"
FILM_EDGES = "/world/film/edges"
FILM_TRAJECTORY = "/world/film/trajectory"
SOLVER_PLOTS = "/plots/solver"
FRAME_PLOTS = "/plots/frames"
APART = "/plots/apart_m"
BARS = "/bars"
RECIPE = "/text/recipe"
LOG = "/text/log"
SOURCE = "/text/source"
SCORES = "/text/scores"
DIAGNOSIS = "/text/diagnosis"
PAIRS_TEXT = "/text/pairs"
LEGEND = "/text/legend"

SCANNER = "scanner"
"""Detail of the frames' part where they are those of a scanner, x ahead and z up."""
PART_SUFFIX = ".rrd"

_PART = re.compile(r"\d{3}-(?P<stage>[a-z]+)(?:-(?P<detail>.+))?$")


def slug(name: str) -> str:
    """The name as one part of an entity path or of a file name."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_") or "unnamed"


def round_name(outer: int) -> str:
    """The trajectory of outer round 1, 2, …"""
    return f"round_{outer}"


def trajectory(name: str) -> str:
    """The line of a trajectory."""
    return f"{TRAJECTORIES}/{slug(name)}"


def frusta(name: str) -> str:
    """The camera frusta along a trajectory."""
    return f"{trajectory(name)}/frusta"


def poses(name: str) -> str:
    """The poses of a trajectory, one transform for each frame."""
    return f"{trajectory(name)}/poses"


def edges(outer: int) -> str:
    """The viewing graph of an outer round, under the poses it was made with."""
    return f"{EDGES}/{round_name(outer)}"


def rejected(outer: int) -> str:
    """The candidate pairs of an outer round that became no edges."""
    return f"{edges(outer)}/rejected"


def registration(outer: int) -> str:
    """The numbers of every pair that was registered in an outer round, in columns."""
    return f"/registration/{round_name(outer)}"


def pair(name: str) -> str:
    """The clouds of a chosen pair, in a space of their own: the axes of frame i."""
    return f"{PAIRS}/{slug(name)}"


def complex_mesh(outer: int) -> str:
    """The triangles of an outer round's viewing graph."""
    return f"{COMPLEX}/{round_name(outer)}"


def complex_text(outer: int) -> str:
    """The complex in numbers, and the energy of the 1-form on it."""
    return f"/text/complex/{round_name(outer)}"


def growth(step: int) -> str:
    """The points that step 0, 1, … adds to the model."""
    return f"{GROWTH}/step_{step:02d}"


def verdict(name: str) -> str:
    """The edges that the diagnosis calls so."""
    return f"{VERDICTS}/{slug(name)}"


def solved_edges(outer: int) -> str:
    """The viewing graph of an outer round, under the poses that its solve gave."""
    return f"{edges(outer)}/solved"


def graph_text(outer: int) -> str:
    """The viewing graph's counts in an outer round."""
    return f"/text/graph/{round_name(outer)}"


def under(parent: str, name: str) -> str:
    """The entity of a named series, bar chart or table."""
    return "/".join([parent, *(slug(part) for part in name.split("/"))])


def part_name(number: int, stage: str, detail: str) -> str:
    """The file name of a stage's part: its number gives the order of the run."""
    return f"{number:03d}-{stage}" + (f"-{slug(detail)}" if detail else "") + PART_SUFFIX


def parse_part(file_name: str) -> tuple[str, str]:
    """Stage and detail of a part's file name; empty where it is none."""
    match = _PART.match(file_name.removesuffix(PART_SUFFIX))
    return (match["stage"], match["detail"] or "") if match else ("", "")
