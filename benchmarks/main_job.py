"""What the main job costs and reaches: CPU seconds a frame by part, memory, errors and scores of one run or of several.

    python benchmarks/main_job.py tum=fr1_xyz seven_scenes=redkitchen video --open3d --orb-slam3
    python benchmarks/main_job.py demo=SEQUENCE --frames 1000 5000 20000 --plot length.svg

Each is RECIPE=PATH, or the word video: the sequence of `hodge demo --video`. All its frames are run in a fresh process,
or the first N; one that has fewer is played back and forth. Beside consecutive frames Open3D's RGB-D odometry and
ORB-SLAM3 (see `orb_slam3.py`) can be run. The tables are Markdown, the plot shows time and memory against frames.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

HEADER = (
    *("sequence", "frames", "CPU s", "CPU ms a frame", "wall s", "peak MB (in)", "page, recording MB"),
    *("ATE cm", "largest cm", "RPE mm", "RPE °", "scores (truth's)"),
)
CONSECUTIVE_S = 0.05
"""Seconds between the frames of a camera that delivers 20 a second, below which they count as consecutive."""

SCRIPT = """
import sys
from pathlib import Path
import hodge_pipeline
from hodge_pipeline.store.memory import keep_memory
keep_memory()  # as the command does
from benchmarks.back_and_forth import first_frames
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.sources.opening import open_with_reader
name, path, out, count, *overrides = sys.argv[1:]
recipe = load_recipe(name, overrides, Path(path))
whole, _ = open_with_reader(Path(path), recipe.source.reader)
hodge_pipeline.run(recipe, out, source=first_frames(whole, int(count) or len(whole.frames)))
"""


def measure(recipe: str, source: Path, frames: int, overrides: list[str], keep: Path | None) -> dict[str, Any]:
    """The report of one run in a fresh process, with `total_cpu_s` and `total_wall_s` of the process tree.

    Of all frames where `frames` is 0; the run folder is kept in `keep`.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = keep / f"{recipe}-{source.name}-{frames or 'all'}" if keep else Path(folder) / "run"
        paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": paths}
        before, begin = os.times(), time.perf_counter()
        command = [sys.executable, "-c", SCRIPT, recipe, str(source), str(out), str(frames), *overrides]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, env=environment, check=False)
        if done.returncode:
            sys.exit(done.stderr)
        after = os.times()
        report: dict[str, Any] = json.loads((out / "report.json").read_text())
        sizes = {file.name: file.stat().st_size / 1e6 for file in (out / "report.html", *out.glob("recording.rrd"))}
        posed = sum(not line.startswith("#") for line in (out / "poses.tum").read_text().splitlines())
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {
        **report,
        "frames": posed,
        "total_cpu_s": cpu,
        "total_wall_s": time.perf_counter() - begin,
        "sizes_mb": sizes,
    }


def peer_row(peer: str, recipe_name: str, path: Path, frames: int, overrides: list[str]) -> str:
    """The row of this peer, a dash for what it does not give; empty where the frames are not consecutive."""
    import numpy as np

    from benchmarks.back_and_forth import first_frames
    from hodge_pipeline.evaluation.trajectory import absolute_error, relative_error
    from hodge_pipeline.recipe.schema import load_recipe
    from hodge_pipeline.scene import has_real_stamps, true_poses
    from hodge_pipeline.sources.opening import open_with_reader

    whole, _ = open_with_reader(path, load_recipe(recipe_name, overrides, path).source.reader)
    step = float(np.median(np.diff([frame.stamp_s for frame in whole.frames])))
    if step > (CONSECUTIVE_S if has_real_stamps(whole.frames) else 1.0):
        return ""
    source = first_frames(whole, frames or len(whole.frames))
    truth, count = true_poses(source), len(source.frames)
    poses, lost, cpu_s = PEERS[peer](source)
    note, cells = f", {lost} lost" if lost else "", "– | – | – | –"
    if (np.isfinite(truth) & np.isfinite(poses)).any():
        error, moved = absolute_error(poses, truth), relative_error(poses, truth)
        cells = (
            f"{100 * error.rmse_m:.2f} | {100 * error.max_m:.1f} | {1e3 * moved.translation_rmse_m:.1f} | "
            f"{moved.rotation_rmse_deg:.2f}"
        )
    return f"| {peer}{note} | {count} | {cpu_s:.1f} | {1e3 * cpu_s / count:.0f} | – | – | – | {cells} | – |\n"


def _by_open3d(source: Any) -> Any:
    from benchmarks.open3d_odometry import tracked_by_open3d

    return tracked_by_open3d(source)


def _by_orb_slam3(source: Any) -> Any:
    from benchmarks.orb_slam3 import tracked_by_orb_slam3

    return tracked_by_orb_slam3(source)


PEERS = {"Open3D's odometry": _by_open3d, "ORB-SLAM3": _by_orb_slam3}


def errors(report: dict[str, Any]) -> str:
    """The cells of a result's errors and scores; a dash where there is no truth."""
    row = {row["name"]: row for row in report["trajectories"]}.get("result")
    if row is None:
        return "– | – | – | – | –"
    return (
        f"{100 * row['ate_rmse_m']:.2f} | {100 * row['ate_max_m']:.1f} | {1e3 * row['rpe_translation_m']:.1f} | "
        f"{row['rpe_rotation_deg']:.2f} | "
        f"{scores(report)}"
    )


def scores(report: dict[str, Any]) -> str:
    """Mean scores on both graphs, those of the true poses in brackets."""
    table = report["scores"]
    if not table:
        return "–"
    poses = [graph["poses"] for graph in table["graphs"].values()]
    cells = [f"{one['result']['score']:.4f} ({one['truth']['score']:.4f})" for one in poses]
    return ", ".join(cells)


def plot(points: list[tuple[int, float, float]], path: Path) -> None:
    """Draw CPU seconds and peak memory against frames."""
    from matplotlib.figure import Figure

    frames, cpu_s, peak_mb = zip(*sorted(points), strict=True)
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    for axes, values, label in zip(figure.subplots(1, 2), (cpu_s, peak_mb), ("CPU s", "peak MB"), strict=True):
        axes.plot(frames, values, marker="o")
        axes.set(xlabel="frames", ylabel=label, xlim=(0, None), ylim=(0, None))
    figure.savefig(path)


def parts(runs: dict[str, dict[str, Any]]) -> str:
    """CPU milliseconds a frame of each part, its rounds together; what lies outside of the stages is the last row."""
    each: dict[str, dict[str, float]] = {}
    for name, run in runs.items():
        spent = run["total_cpu_s"] - sum(stage["cpu_s"] for stage in run["stages"])
        for stage in (*run["stages"], {"name": "start of processes, libraries", "cpu_s": spent}):
            row = each.setdefault(re.sub(r"(, round)? \d+$", "", stage["name"]), dict.fromkeys(runs, 0.0))
            row[name] += 1e3 * stage["cpu_s"] / run["frames"]
    each["start of processes, libraries"] = each.pop("start of processes, libraries")
    lines = [f"| CPU ms a frame | {' | '.join(runs)} |", "|---" * (1 + len(runs)) + "|"]
    lines += [
        f"| {part} | {' | '.join(f'{ms:.1f}' if ms else '–' for ms in row.values())} |" for part, row in each.items()
    ]
    return "\n".join(lines)


def row(name: str, run: dict[str, Any]) -> str:
    """The table's row of one run."""
    highest = max(run["stages"], key=lambda stage: stage["peak_mb"])
    sizes, cpu_s = ", ".join(f"{size:.1f}" for size in run["sizes_mb"].values()), run["total_cpu_s"]
    return (
        f"| {name} | {run['frames']} | {cpu_s:.1f} | {1e3 * cpu_s / run['frames']:.0f} | {run['total_wall_s']:.1f} | "
        f"{highest['peak_mb']:.0f} ({highest['name']}) | {sizes} | {errors(run)} |"
    )


def job(text: str) -> tuple[str, str, Path]:
    """What an argument is called in the table, and the recipe and the path that it means."""
    if text == "video":
        from hodge_pipeline.demo.sequence import DemoOptions, demo_source

        return "demo video", "tum", demo_source(DemoOptions.video())
    recipe, equals, path = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text}: give RECIPE=PATH, such as tum=fr1_xyz, or the word video")
    return Path(path).name, recipe, Path(path)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", type=job, nargs="+", metavar="RECIPE=PATH")
    parser.add_argument("--frames", type=int, nargs="+", default=[0], help="how many are run; 0: all")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each; that of the median CPU time is printed")
    for flag, peer in zip(("--open3d", "--orb-slam3"), PEERS, strict=True):
        text = f"{peer} beside those of consecutive frames"
        parser.add_argument(flag, dest="peers", action="append_const", const=peer, default=[], help=text)
    parser.add_argument("--plot", type=Path, help="an SVG file: CPU seconds and peak memory against frames")
    parser.add_argument("--keep", type=Path, help="a folder that keeps the runs")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    print(f"| {' | '.join(HEADER)} |\n{'|---' * len(HEADER)}|")
    kept: dict[str, dict[str, Any]] = {}
    for name, recipe, path in options.sources:
        for frames in options.frames:
            repeated = [measure(recipe, path, frames, options.overrides, options.keep) for _ in range(options.repeat)]
            cpu_s = statistics.median_low([run["total_cpu_s"] for run in repeated])
            run = next(run for run in repeated if run["total_cpu_s"] == cpu_s)
            kept[f"{name}, {run['frames']}"] = run
            print(row(name, run), flush=True)
            for peer in options.peers:
                # in a process of its own: a second ORB-SLAM3 of one process goes astray
                with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
                    line = fresh.submit(peer_row, peer, recipe, path, frames, options.overrides).result()
                print(line, end="", flush=True)
            if options.plot:
                points = [
                    (one["frames"], one["total_cpu_s"], max(stage["peak_mb"] for stage in one["stages"]))
                    for one in kept.values()
                ]
                plot(points, options.plot)
    print(f"\n{parts(kept)}")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main()
