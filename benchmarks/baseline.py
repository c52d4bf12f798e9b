"""What the program makes of real data, stored outside the tree, and what a change of the code did to it.

    python benchmarks/baseline.py store ../hodge-baseline              # once, with the code as it is
    python benchmarks/baseline.py compare ../hodge-baseline            # runs the cases again and says what changed
    python benchmarks/baseline.py compare ../hodge-baseline --only sphere2500 redkitchen

Every case is one command of `hodge`; poses, edges with status and verdict, notes, exit code and CPU seconds are read
from the files that it leaves for people, so that the code behind them may change its shape. Two sets of poses are
compared as they are, without alignment. Exit code 1 where anything but the CPU time differs by more than the tolerance.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

DATA = Path(os.environ.get("HODGE_DATA", "../shared/data"))
TOLERANCE = 1e-6
"""Of the scene's extent, and in radians: what reordered arithmetic may do to the poses."""
PAIR_ESTIMATES = "fragments/pair_estimates"
RUNS = {
    "redkitchen": ("seven_scenes", "seven_scenes/redkitchen"),
    "fr1_rpy_part": ("tum", "tum/fr1_rpy_part"),
    "icl_nuim": ("icl_nuim", "icl_nuim/livingroom1_redwood"),
    "fragments": ("scans", "fragments/redkitchen_3dmatch"),
}


@dataclass(frozen=True)
class Case:
    """A command of `hodge` (without the program's name) that leaves `folder`, and the data (or None) that it reads."""

    name: str
    arguments: tuple[str, ...]
    data: Path | None


@dataclass(frozen=True)
class Result:
    """What a command left: exit code, CPU seconds, notes, edges as text with how often each occurs."""

    code: int
    cpu_s: float
    headline: str
    notes: list[str]
    edges: dict[str, int]


def cases() -> list[Case]:
    """Every case; the graphs of pair estimates by scene and method."""
    found = [
        Case(name, ("run", recipe, "--source", str(DATA / source), "--out", "{out}"), DATA / source)
        for name, (recipe, source) in RUNS.items()
    ]
    model = DATA / "colmap/lund_door/set1_lund_door"
    truth = str(model / "colmap_ground_truth")
    found.append(Case("lund_door", ("refine", "colmap", truth, "--out", "{out}"), model))
    graph = DATA / "pose_graphs/sesync/sphere2500.g2o"
    found.append(Case("sphere2500", ("solve", str(graph), "--out", "{out}/poses.tum", "--run", "{out}"), graph))
    garage = graph.with_name("parking-garage.g2o")  # in one piece: it was parted once where two steps share a blame
    found.append(Case("parking-garage", ("diagnose", str(garage), "--out", "{out}"), garage))
    for log in sorted((DATA / PAIR_ESTIMATES).glob("*/*.log")):
        if log.name != "gt.log":
            name = f"{log.parent.name.removesuffix('-evaluation')}-{log.stem}"
            found.append(Case(name, ("diagnose", str(log), "--out", "{out}"), log))
    return [*found, Case("demo", ("demo", "--out", "{out}"), None)]


def run(case: Case, folder: Path) -> tuple[Result, Floats]:
    """The result of a case and its poses (N, 4, 4)."""
    folder.mkdir(parents=True)
    arguments = [part.replace("{out}", str(folder)) for part in case.arguments]
    before = os.times()
    hodge = [sys.executable, "-c", "from hodge_pipeline.cli.entry import main; main()"]
    done = subprocess.run([*hodge, *arguments, "--quiet"], capture_output=True, text=True)
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    report = json.loads((folder / "report.json").read_text()) if (folder / "report.json").is_file() else {}
    headline = str((report.get("verdict") or {}).get("sentence", "")) or done.stderr.strip()
    notes = [note["text"] for note in report.get("notes", [])]
    return Result(done.returncode, cpu_s, headline, notes, edges(folder)), poses(folder)


def poses(folder: Path) -> Floats:
    """The poses (N, 4, 4) in a folder: those of KITTI's file where there is one, which holds them to the last bit."""
    for name in sorted(folder.glob("poses*.kitti")) or sorted(folder.glob("poses*.tum")):
        rows = np.loadtxt(name, ndmin=2)
        if name.suffix == ".kitti":
            return np.concatenate([rows.reshape(-1, 3, 4), np.tile([[[0, 0, 0, 1.0]]], (len(rows), 1, 1))], axis=1)
        return se3.from_quat_xyzw(rows[:, 1:4], rows[:, 4:8])
    return np.zeros((0, 4, 4))


def edges(folder: Path) -> dict[str, int]:
    """Every row of `edges*.csv` as `i-j source status verdict`, and how often it occurs; of a rejected pair the reason
    stands for the source.
    """
    found: Counter[str] = Counter()
    for path in sorted(folder.glob("edges*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                status = row.get("status", "")
                source = row.get("why") or row["source"] if status == "rejected" else row["source"]
                found[f"{row['i']}-{row['j']} {source} {status} {row.get('verdict', '')}"] += 1
    return dict(found)


def differences(old: Result, new: Result, old_poses: Floats, new_poses: Floats) -> tuple[list[str], bool]:
    """What changed, a line each, and whether all of it lies within the tolerance."""
    if old_poses.shape != new_poses.shape:
        return [f"{len(old_poses)} poses -> {len(new_poses)}"], False
    lines, same = [], True
    if not np.array_equal(old_poses, new_poses, equal_nan=True):
        away = se3.inverse(old_poses) @ new_poses
        moved_m = float(np.nanmax(np.linalg.norm(away[:, :3, 3], axis=1)))
        turned = float(np.nanmax(np.linalg.norm(se3.so3_log(away[:, :3, :3]), axis=1)))
        extent_m = float(np.linalg.norm(np.ptp(old_poses[:, :3, 3], axis=0)))
        lines.append(f"poses moved by up to {moved_m:.2e} m of {extent_m:.3g} m, {turned:.2e} rad")
        same = moved_m <= TOLERANCE * extent_m and turned <= TOLERANCE
    for name, before, after in (
        ("edges", Counter(old.edges), Counter(new.edges)),
        ("notes", Counter(old.notes), Counter(new.notes)),
        ("headline", Counter([old.headline]), Counter([new.headline])),
        ("exit code", Counter([str(old.code)]), Counter([str(new.code)])),
    ):
        gone, come = before - after, after - before
        if gone or come:
            same = False
            lines.append(f"{name}: {gone.total()} gone, {come.total()} new")
            lines += [f"  - {one}" for one in list(gone)[:5]] + [f"  + {one}" for one in list(come)[:5]]
    return lines, same


def main() -> int:
    """Store or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("store", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", help="names of cases")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    failed = False
    for case in cases():
        if options.only and case.name not in options.only:
            continue
        if case.data is not None and not case.data.exists():
            print(f"{case.name:<32} skipped: no {case.data}")
            continue
        stored = options.folder / case.name
        if options.what == "compare" and not stored.with_suffix(".json").is_file():
            print(f"{case.name:<32} skipped: not stored")
            continue
        with tempfile.TemporaryDirectory() as scratch:
            new, new_poses = run(case, Path(scratch) / "out")
        failed |= not _show(case, stored, new, new_poses, store=options.what == "store")
    return int(failed)


def _show(case: Case, stored: Path, new: Result, new_poses: Floats, *, store: bool) -> bool:
    sizes = f"{len(new_poses)} poses, {sum(new.edges.values())} edges"
    facts = f"{case.name:<32} exit {new.code}, {new.cpu_s:6.1f} CPU s, {sizes}"
    if store:
        np.save(stored.with_suffix(".npy"), new_poses)
        stored.with_suffix(".json").write_text(json.dumps(asdict(new), indent=1))
        print(facts, flush=True)
        return True
    old: dict[str, Any] = json.loads(stored.with_suffix(".json").read_text())
    lines, same = differences(Result(**old), new, np.load(stored.with_suffix(".npy")), new_poses)
    told = "bit-equal" if not lines else "within tolerance" if same else "DIFFERS"
    print(f"{facts} (was {old['cpu_s']:.1f} CPU s): {told}", *lines, sep="\n    ", flush=True)
    return same


if __name__ == "__main__":
    sys.exit(main())
