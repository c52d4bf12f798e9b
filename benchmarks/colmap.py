"""Is `hodge refine colmap` ever worse than its input or plain bundle adjustment? Prints a table, exit code 1 if so.

    python benchmarks/colmap.py                                  # the models of HODGE_DATA, synthetic ones; five seeds
    python benchmarks/colmap.py scene/sparse/0 --seeds 1 --kinds noise wrong
    python benchmarks/colmap.py --write                          # benchmarks/colmap.md

Each model is taken for good and disturbed: `noise`: 0.5° and 2 % of the scene for each image; `big`: 8° and 15 %;
`carried`: so, and every point moved with its images; `wrong`: 15 % of the images 15° and 25 % off; `halves`: two
overlapping models, each in a gauge and unit of its own; `renamed`, `no_images`, `no_database`: noise, and images under
other names than the database's, or without images or database. The peer is pycolmap's bundle adjustment with cameras
held. Centres are root mean squares after a similarity, in % of the extent of the cameras, against the good model or, if
it has a folder `true`, the one there; CPU seconds are those of whole processes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from synthetic_colmap import TRUE, make

from hodge_adapters.colmap.content import read_reconstruction
from hodge_pipeline import se3

KINDS = ("given", "noise", "big", "wrong", "carried", "halves", "renamed", "no_images", "no_database")
MODELS = (
    "disturbed/mouse_good",
    "disturbed/maupertuis_good",
    "lund_door/set1_lund_door/colmap_ground_truth",
    "astrovision_vesta/test_2011212_opnav_022",
)
SYNTHETIC = (("rings", 150), ("turntable", 118), ("facade", 60), ("room", 128), ("street", 80), ("joined", 80))
"""Kinds and images of `benchmarks/synthetic_colmap.py`, seed 1."""
MOST_WORSE_PERCENT = 0.1
CPU_FACTOR, CPU_EXTRA_S = 5.0, 10.0
PEER = """
import sys, pycolmap
model, options = pycolmap.Reconstruction(sys.argv[1]), pycolmap.BundleAdjustmentOptions()
options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
options.print_summary = False
pycolmap.bundle_adjustment(model, options)
model.write(sys.argv[2])
"""


class Row(NamedTuple):
    """One disturbed model: errors in %, medians of reprojection in pixels, seconds of CPU, what was kept."""

    model: str
    kind: str
    seed: int
    input_percent: float
    peer_percent: float
    ours_percent: float
    input_px: float
    peer_px: float
    ours_px: float
    peer_s: float
    ours_s: float
    kept: str

    @property
    def failure(self) -> str:
        """What is not as promised, empty where all is."""
        allowed = min(self.input_percent, self.peer_percent) + MOST_WORSE_PERCENT
        worse = "" if self.ours_percent <= allowed else "worse"
        slow = "" if self.ours_s <= CPU_FACTOR * self.peer_s + CPU_EXTRA_S else "slow"
        return " ".join(part for part in (worse, slow) if part)


def measured(good: Path, kind: str, seed: int, work: Path) -> Row:
    """One model disturbed, refined by us and by the peer, and compared."""
    starts = disturbed(good, work / "start", kind, seed)
    peers, peer_s = [], 0.0
    for number, start in enumerate(starts):
        peer = work / "peer" / str(number)
        peer.mkdir(parents=True)
        peer_s += cpu_of([sys.executable, "-c", PEER, str(start), str(peer)])[0]
        peers.append(peer)
    out = work / "out"
    command = [shutil.which("hodge") or "hodge", "refine", "colmap", str(work / "start"), "--out", str(out), "--json"]
    seconds, text = cpu_of([*command, *beside(good, kind)])
    ours = sorted((out / "sparse").glob("*"))
    peers = [peer for peer in peers if any(peer.iterdir())]  # pycolmap refuses some models
    true = good / TRUE if (good / TRUE).is_dir() else good
    sets = [[compared(true, model, kind) for model in models] for models in (starts, peers, ours)]
    percent = [max((one[0] for one in found), default=float("inf")) for found in sets]
    px = [max((one[1] for one in found), default=float("inf")) for found in sets]
    report = json.loads(text) if text.startswith("{") else {}
    kept = report.get("refinement", {}).get("outcome", "failed")
    if kind == "given" and same_bytes(starts[0], ours):
        kept = "same bytes"
    return Row(label(good), kind, seed, *percent, *px, peer_s, seconds, kept)


def beside(good: Path, kind: str) -> list[str]:
    """The database and images that lie beside the good model, where this kind has them."""
    above = [good, *good.parents[:3]]
    images = next((one / "images" for one in above if (one / "images").is_dir()), None)
    database = next((one / "database.db" for one in above if (one / "database.db").is_file()), None)
    if kind == "no_images":
        images = None
    if kind == "no_database":
        database = None
    return ["--images", str(images or "none"), "--database", str(database or "none")]


def disturbed(good: Path, out: Path, kind: str, seed: int) -> list[Path]:
    """The folders of the disturbed model; points, tracks and cameras stay."""
    rng, model = np.random.default_rng(seed), read_reconstruction(good)
    ids = sorted(model.reg_image_ids())
    size = extent(model)
    if kind == "halves":
        return list(_halves(good, ids, out, rng))
    if kind == "given":
        shutil.copytree(good, out, ignore=lambda _, names: [n for n in names if Path(n).suffix not in (".bin", ".txt")])
        return [out]
    if kind == "wrong":
        for image_id in rng.choice(ids, max(1, round(0.15 * len(ids))), replace=False):
            away = rng.normal(size=3)
            turn = rng.normal(size=3) * np.deg2rad(15) / 3**0.5
            _move(model, int(image_id), turn, away / np.linalg.norm(away) * 0.25 * size)
    else:
        degrees, share = (8.0, 0.15) if kind in ("big", "carried") else (0.5, 0.02)
        for image_id in ids:
            turn = rng.normal(size=3) * np.deg2rad(degrees) / 3**0.5
            _move(model, image_id, turn, rng.normal(size=3) * share * size / 3**0.5)
    if kind == "carried":
        _carry(model, read_reconstruction(good))
    if kind == "renamed":
        for image in model.images.values():
            image.name = f"other/{image.name}"
    out.mkdir()
    model.write(out)
    return [out]


def _halves(good: Path, ids: Sequence[int], out: Path, rng: np.random.Generator) -> Iterator[Path]:
    count, both = len(ids), max(2, len(ids) // 6)
    for number, keep in enumerate((ids[: count // 2 + both // 2 + 1], ids[count // 2 - both // 2 :])):
        half = read_reconstruction(good)
        for image_id in set(ids) - set(keep):
            half.deregister_frame(half.images[image_id].frame_id)
        turn = pycolmap.Rotation3d(se3.so3_exp(rng.normal(size=3)))
        half.transform(pycolmap.Sim3d(float(np.exp(0.5 * rng.normal())), turn, 5 * rng.normal(size=3)))
        folder = out / str(number)
        folder.mkdir(parents=True)
        half.write(folder)
        yield folder


def _move(model: pycolmap.Reconstruction, image_id: int, turn_rad: np.ndarray, shift: np.ndarray) -> None:
    image = model.images[image_id]
    rotation = se3.so3_exp(turn_rad) @ image.cam_from_world().rotation.matrix()
    centre = image.projection_center() + shift
    model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)


def _carry(model: pycolmap.Reconstruction, good: pycolmap.Reconstruction) -> None:
    """Move each point by the mean of what moved its images: none is right any more."""
    moves = {
        key: image.cam_from_world().inverse() * good.images[key].cam_from_world() for key, image in model.images.items()
    }
    for point in model.points3D.values():
        point.xyz = np.mean([moves[one.image_id] * point.xyz for one in point.track.elements], axis=0)


def extent(model: pycolmap.Reconstruction) -> float:
    """The diagonal of the box around the cameras."""
    centres = [model.images[image_id].projection_center() for image_id in model.reg_image_ids()]
    return float(np.linalg.norm(np.ptp(centres, axis=0)))


def compared(good: Path, other: Path, kind: str) -> tuple[float, float]:
    """Centres in % of the good model's extent after a similarity, and the median reprojection error in pixels."""
    there, here = read_reconstruction(good), read_reconstruction(other)
    prefix = "other/" if kind == "renamed" else ""
    known = {prefix + there.images[key].name: there.images[key].projection_center() for key in there.reg_image_ids()}
    pairs = [(here.images[key].projection_center(), known[here.images[key].name]) for key in here.reg_image_ids()]
    a, b = (np.array(column) for column in zip(*pairs, strict=True))
    left, values, right = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = (values * signs).sum() / ((a - a.mean(0)) ** 2).sum()
    away = scale * (a - a.mean(0)) @ ((left * signs) @ right).T + b.mean(0) - b
    return 100 * float(np.sqrt((away**2).sum(1).mean())) / extent(there), _median_px(here)


def _median_px(model: pycolmap.Reconstruction) -> float:
    errors = []
    for point in model.points3D.values():
        for one in point.track.elements:
            image = model.images[one.image_id]
            seen = image.project_point(point.xyz)
            xy = image.points2D[one.point2D_idx].xy
            errors.append(np.inf if seen is None else float(np.linalg.norm(seen - xy)))
    return float(np.median(errors)) if errors else float("nan")


def same_bytes(start: Path, ours: Sequence[Path]) -> bool:
    """Whether the result is the input, byte for byte."""
    files = {file.name: file.read_bytes() for file in start.iterdir() if file.stem in ("cameras", "images", "points3D")}
    return len(ours) == 1 and all((ours[0] / name).read_bytes() == data for name, data in files.items())


def cpu_of(command: Sequence[str]) -> tuple[float, str]:
    """Seconds of CPU of a process and its children, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, found.stdout


def label(good: Path) -> str:
    """A short name of a model by its folder."""
    plain = ("0", "sparse", "colmap_ground_truth", "text", "model")
    return next(part for part in reversed(good.resolve().parts) if part not in plain)


def table(rows: Sequence[Row]) -> Iterator[str]:
    """A table in Markdown, one line for each disturbed model."""
    names = [f"{who} {unit}" for unit in ("%", "px") for who in ("input", "peer", "ours")]
    yield f"| model | disturbed | seed | {' | '.join(names)} | peer s | ours s | kept | |"
    yield "|" + "---|" * 13
    for row in rows:
        numbers = [*(f"{one:.4f}" for one in row[3:6]), *(f"{one:.3f}" for one in row[6:9])]
        seconds = [f"{one:.1f}" for one in row[9:11]]
        yield f"| {' | '.join([row.model, row.kind, str(row.seed), *numbers, *seconds, row.kept, row.failure])} |"


def _synthetic(folder: Path) -> Iterator[Path]:
    for kind, images in SYNTHETIC:
        out = folder / f"{kind}{images}"
        out.mkdir()
        make(kind, images, 1).write(out)
        yield out


def _rows(models: Iterable[Path], options: argparse.Namespace) -> Iterator[Row]:
    for good in models:
        for kind in options.kinds:
            for seed in range(1 if kind == "given" else options.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    row = measured(good, kind, seed, Path(folder))
                print(list(table([row]))[-1], flush=True)
                yield row


def main() -> int:
    """Print the table; 1 where a line is not as promised."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path, help="folders of good models; default: see above")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="the table into benchmarks/colmap.md")
    options = parser.parse_args()
    data = Path(os.environ.get("HODGE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "colmap"
    with tempfile.TemporaryDirectory() as made:
        rows = list(_rows(options.models or [*(data / name for name in MODELS), *_synthetic(Path(made))], options))
    failed = sum(bool(row.failure) for row in rows)
    print(f"{len(rows)} cases, {failed} not as promised")
    if options.write:
        text = "\n".join(
            ["# `hodge refine colmap` against its input and plain bundle adjustment", "", *table(rows), ""]
        )
        Path(__file__).with_suffix(".md").write_text(text, "utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
