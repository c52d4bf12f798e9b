"""What the main job costs: CPU and wall seconds and peak memory of each stage, and how they grow with the frames.

    python benchmarks/main_job.py SEQUENCE [--recipe seven_scenes] [--frames 50 100 200 250] [--repeat 1]
    python benchmarks/main_job.py SEQUENCE --frames 1000 5000 20000 --plot length.svg
    OMP_NUM_THREADS=1 python benchmarks/main_job.py SEQUENCE --recipe tum --frames 60 --open3d

The first N frames of the sequence are run in a fresh process each; one that has fewer is played back and forth. The
table is Markdown, the plot shows time and memory against frames.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

SCRIPT = """
import sys
from pathlib import Path
import hodge_pipeline
from benchmarks.back_and_forth import first_frames
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.sources.opening import open_with_reader
name, path, out, count, *overrides = sys.argv[1:]
recipe = load_recipe(name, overrides, Path(path))
whole, _ = open_with_reader(Path(path), recipe.source.reader)
hodge_pipeline.run(recipe, out, source=first_frames(whole, int(count)))
"""


def measure(recipe: str, source: Path, frames: int, overrides: list[str]) -> dict[str, Any]:
    """The report of one run in a fresh process, with `total_cpu_s` and `total_wall_s` of the process tree."""
    import os
    import time

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": paths}
        before, begin = os.times(), time.perf_counter()
        command = [sys.executable, "-c", SCRIPT, recipe, str(source), str(out), str(frames), *overrides]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, env=environment, check=False)
        if done.returncode:
            sys.exit(done.stderr)
        after = os.times()
        report: dict[str, Any] = json.loads((out / "report.json").read_text())
        sizes = {name: (out / name).stat().st_size / 1e6 for name in ("report.html", "recording.rrd")}
        posed = sum(not line.startswith("#") for line in (out / "poses.tum").read_text().splitlines())
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {
        **report,
        "frames": posed,
        "total_cpu_s": cpu,
        "total_wall_s": time.perf_counter() - begin,
        "sizes_mb": sizes,
    }


def open3d_odometry(name: str, path: Path, frames: int, overrides: list[str]) -> str:
    """The row of Open3D's odometry."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from benchmarks.back_and_forth import first_frames
    from benchmarks.open3d_odometry import open3d_row
    from hodge_pipeline.recipe.schema import load_recipe
    from hodge_pipeline.sources.opening import open_with_reader

    whole, _ = open_with_reader(path, load_recipe(name, overrides, path).source.reader)
    return open3d_row(first_frames(whole, frames))


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

    frames, cpu_s, peak_mb = zip(*points, strict=True)
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    for axes, values, label in zip(figure.subplots(1, 2), (cpu_s, peak_mb), ("CPU s", "peak MB"), strict=True):
        axes.plot(frames, values, marker="o")
        axes.set(xlabel="frames", ylabel=label, xlim=(0, None), ylim=(0, None))
    figure.savefig(path)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--recipe", default="seven_scenes")
    parser.add_argument("--frames", type=int, nargs="+", default=[50, 100, 200, 250])
    parser.add_argument("--repeat", type=int, default=1, help="runs of each; the medians are printed")
    parser.add_argument("--open3d", action="store_true", help="beside it Open3D's RGB-D odometry of the same frames")
    parser.add_argument("--plot", type=Path, help="an SVG file: CPU seconds and peak memory against frames")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    header = (
        *("frames", "CPU s", "CPU ms a frame", "wall s", "peak MB", "page, recording MB"),
        *("ATE cm", "largest cm", "RPE mm", "RPE °", "scores (truth's)"),
    )
    print(f"| {' | '.join(header)} |\n{'|---' * len(header)}|")
    last: dict[str, Any] = {}
    points: list[tuple[int, float, float]] = []
    for frames in options.frames:
        runs = [measure(options.recipe, options.source, frames, options.overrides) for _ in range(options.repeat)]
        cpu, wall = (statistics.median(run[key] for run in runs) for key in ("total_cpu_s", "total_wall_s"))
        peak = statistics.median(max(stage["peak_mb"] for stage in run["stages"]) for run in runs)
        posed = runs[0]["frames"]
        sizes = ", ".join(f"{size:.1f}" for size in runs[0]["sizes_mb"].values())
        print(
            f"| {posed} | {cpu:.1f} | {1e3 * cpu / posed:.0f} | {wall:.1f} | {peak:.0f} | {sizes} | "
            f"{errors(runs[0])} |",
            flush=True,
        )
        last = runs[0]
        if options.open3d:
            print(open3d_odometry(options.recipe, options.source, frames, options.overrides), flush=True)
        points.append((posed, cpu, peak))
        if options.plot:
            plot(points, options.plot)
    posed = last["frames"]
    print(f"\n| stage ({posed} frames) | CPU s | CPU ms a frame | wall s | peak MB |\n|---|---|---|---|---|")
    for stage in last["stages"]:
        each = 1e3 * stage["cpu_s"] / posed
        print(
            f"| {stage['name']} | {stage['cpu_s']:.1f} | {each:.1f} | {stage['wall_s']:.1f} | {stage['peak_mb']:.0f} |"
        )


if __name__ == "__main__":
    main()
