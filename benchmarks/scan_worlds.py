"""Scans of modelled worlds in no order, whole: which pairs come out in one piece, rightly and wrongly.

    OMP_NUM_THREADS=1 python benchmarks/scan_worlds.py [--worlds street twins_quarter] [--seeds 0 1 2] [--beams 32]

Each world is scanned from eight stations at rest, turned at random. A pair counts as joined where its scans end in one
piece of `hodge run scans`; it is right within a tenth of the scene's scale and 3 degrees. Pairs of two places, such as
the two streets of `twins_*`, can only be wrong.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d

import hodge_pipeline
from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.demo import street as block
from hodge_pipeline.demo.parts import motion
from hodge_pipeline.demo.shapes import Mesh, box
from hodge_pipeline.demo.sweeps import FARTHEST_M, HIGHEST_DEG, LOWEST_DEG
from hodge_pipeline.recipe.scale import measured_scale
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.types import Floats, Frame, Ints, PointCloud, Source
from hodge_pipeline.types.edges import USED

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from lidar_worlds import WORLDS as WALKS  # noqa: E402

STATIONS, APART_M = 8, 6.0
RIGHT_M, RIGHT_DEG = 0.1, 3.0
"""Metres of a room, times the scene's scale."""
LORRY, LORRIES = (9.0, 2.4, 3.0), 0.25
LANES_M, CLEAR_M = (0.0, 3.0), 6.0
"""Lanes of vehicles left of the scanner's; none stands so near to it."""
PAVEMENT_M, MOVED_M = 7.0, (2.0, 4.0)
"""What lies nearer to the middle of a street stands before its houses; how far such a thing is moved."""
OPTIONS = ("recording.level=off", "fusion=[]", "executor={stage: local, workers: 0}")


@dataclass(frozen=True)
class World:
    """What stands, the stations `poses (N, 4, 4)` in it and the place (N,) of each, elevations of the beams in degrees,
    the nearest range and its noise in metres, and what stands beside at each station.
    """

    meshes: Sequence[Mesh]
    poses: Floats
    place: Ints
    beams_deg: tuple[float, float] = (LOWEST_DEG, HIGHEST_DEG)
    nearest_m: float = 2.0
    noise_m: float = 0.02
    passing: Sequence[Sequence[Mesh]] = field(default=())


def street(seed: int, vehicles: int = 0, differ: float | None = None) -> World:
    """A street, with so many vehicles each way on 500 m; where a share is to `differ`, its twin as well, where such a
    share of what stands before the houses stands elsewhere: four stations in each.
    """
    rng = np.random.default_rng([seed, 21])
    road = block.Road(1.0)
    south = list(block._side(np.random.default_rng([seed, 7]), block.HALF_LENGTH_M, block.HALF_WIDTH_M))
    twin = [mesh.moved(motion(0, 0, yaw_deg=180)) for mesh in _other(south, differ or 0.0, rng)]
    meshes = [box(block.GROUND_M, block.GROUND_M, 1.0).moved(motion(0, 0, -1)), *south, *twin]
    here = STATIONS if differ is None else STATIONS // 2
    ways = rng.uniform(5, 30) + APART_M * np.arange(here)
    if differ is not None:
        ways = np.concatenate([ways, ways + road.length_m / 2 + rng.uniform(-2, 2, here)])
    poses = road.world_from_car(ways)
    passing = [list(_vehicles(road, way, vehicles, rng)) for way in ways]
    return World(meshes, _turned(poses, rng), np.arange(len(ways)) // here, passing=passing)


def _other(meshes: Sequence[Mesh], share: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """The meshes of a street, a share of those on its pavement moved along it; those of one spot together."""
    move = np.where(rng.random(100) < share, rng.choice([-1, 1], 100) * rng.uniform(*MOVED_M, 100), 0.0)
    for mesh in meshes:
        stands = np.abs(mesh.vertices[:, 1] + block.HALF_WIDTH_M).max() < PAVEMENT_M
        spot = int((mesh.vertices[:, 0].mean() + block.HALF_LENGTH_M) / 3.0)
        yield mesh.moved(motion(float(move[spot]) if stands else 0.0, 0))


def _vehicles(road: block.Road, way: float, count: int, rng: np.random.Generator) -> Iterator[Mesh]:
    """Vehicles at random on both lanes, but for those beside the scanner."""
    for lane_m in LANES_M:
        for at in rng.uniform(CLEAR_M, road.length_m - CLEAR_M, count):
            x, y, heading = (float(value) for value in road.place(np.array(way + at)))
            size = LORRY if rng.random() < LORRIES else block.CAR
            yield box(*size).moved(motion(x, y, 0.2, np.degrees(heading)) @ motion(0, lane_m))


def walk(seed: int, name: str) -> World:
    """Stations along the way through one of the worlds of the tests."""
    rng = np.random.default_rng([seed, 22])
    path, meshes = WALKS[name](seed)
    times_s = (rng.uniform(0, path.length_m) + APART_M * np.arange(STATIONS)) / path.speed_m_s
    return World(meshes, _turned(path.world_from_car(times_s), rng), np.zeros(STATIONS, int))


def rooms(seed: int, people: int = 0, differ: float = 1.0) -> World:
    """Two rooms of one shell, four stations in each, the second with such a share of other furniture; people move."""
    rng = np.random.default_rng([seed, 23])
    size = np.array([rng.uniform(5, 12), rng.uniform(4, 9)])
    wide, deep = size.tolist()
    shell = [box(wide, deep, 0.1).moved(motion(0, 0, z)) for z in (-0.1, 2.7)]
    for side in (-1, 1):
        shell += [box(0.1, deep, 2.7).moved(motion(side * wide / 2, 0))]
        shell += [box(wide, 0.1, 2.7).moved(motion(0, side * deep / 2))]
    count = int(rng.integers(6, 14))
    first = list(_furniture(count, size, rng))
    second = [*first[round(differ * count) :], *_furniture(round(differ * count), size, rng)]
    away = motion(1000, 0)
    meshes = [*shell, *first, *(mesh.moved(away) for mesh in (*shell, *second))]
    spots = rng.uniform(-0.3, 0.3, (STATIONS, 2)) * size
    place = np.arange(STATIONS) // (STATIONS // 2)
    poses = np.array([motion(1000 * row + x, y, 1.4) for (x, y), row in zip(spots, place, strict=True)])
    passing = [
        [
            box(0.5, 0.35, 1.75).moved(motion(1000 * row + x, y))
            for x, y in rng.uniform(-0.4, 0.4, (people, 2)) * size
            if np.linalg.norm([x, y] - spot) > 0.8
        ]
        for spot, row in zip(spots, place, strict=True)
    ]
    return World(meshes, _turned(poses, rng), place, (-50, 50), 0.3, 0.005, passing)


def _furniture(count: int, size: Floats, rng: np.random.Generator) -> Iterator[Mesh]:
    """Boxes along the walls, some amid the room."""
    for _ in range(count):
        x, y = rng.uniform(-0.42, 0.42, 2) * size
        if rng.random() < 0.7:
            x, y = (x, rng.choice([-1, 1]) * (size[1] / 2 - 0.4)) if rng.random() < 0.5 else (size[0] / 2 - 0.4, y)
        wide, deep = rng.uniform(0.4, 1.6, 2) * [1, 0.5]
        yield box(wide, deep, rng.uniform(0.4, 2.0)).moved(motion(x, y, 0, float(rng.choice([0, 90]))))


def _turned(poses: Floats, rng: np.random.Generator) -> Floats:
    yaw = np.zeros((len(poses), 3))
    yaw[:, 2] = rng.uniform(-np.pi, np.pi, len(poses))
    return np.asarray(poses @ se3.from_parts(se3.so3_exp(yaw), np.zeros((len(poses), 3))))


WORLDS: dict[str, Callable[[int], World]] = {
    "street": street,
    "street_6": partial(street, vehicles=6),
    "street_14": partial(street, vehicles=14),
    "street_30": partial(street, vehicles=30),
    "twins_same": partial(street, differ=0.0),
    "twins_quarter": partial(street, differ=0.25),
    "twins_quarter_14": partial(street, differ=0.25, vehicles=14),
    "twins_half": partial(street, differ=0.5),
    "twins_all": partial(street, differ=1.0),
    "forest": partial(walk, name="forest"),
    "hill": partial(walk, name="hill"),
    "rooms": rooms,
    "rooms_people": partial(rooms, people=3),
    "rooms_half": partial(rooms, differ=0.5),
}


def scans(world: World, seed: int, beams: int, columns: int) -> list[PointCloud]:
    """What a scanner at rest measures from each station."""
    rng = np.random.default_rng([seed, 24])
    up = np.radians(np.linspace(*world.beams_deg, beams))[:, None]
    turn = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    towards = [np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.broadcast_to(np.sin(up), (beams, columns))]
    directions = np.stack(towards, axis=-1).reshape(-1, 3)
    clouds = []
    for row, pose in enumerate(world.poses):
        passing = world.passing[row] if world.passing else ()
        vertices, triangles = block.joined([*world.meshes, *passing])
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)),
        )
        turned = directions @ pose[:3, :3].T
        rays = np.hstack([np.broadcast_to(pose[:3, 3], turned.shape), turned]).astype(np.float32)
        ranges = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy().astype(float)
        ranges += world.noise_m * rng.standard_normal(len(ranges))
        seen = (ranges > world.nearest_m) & (ranges < FARTHEST_M)
        clouds.append(PointCloud((directions[seen] * ranges[seen, None]).astype(np.float32)))
    return clouds


@dataclass(frozen=True)
class Outcome:
    """Pairs of scans joined rightly and wrongly, of `all_pairs` of one place; `pieces` beside `places`; CPU seconds."""

    right: int
    wrong: int
    all_pairs: int
    pieces: int
    places: int
    cpu_s: float


def joined(world: World, clouds: Sequence[PointCloud]) -> Outcome:
    """What `hodge run scans` makes of them."""
    frames = [Frame(row, float(row), read_points=lambda cloud=cloud: cloud) for row, cloud in enumerate(clouds)]
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        source = Source("world", Path(folder), tuple(frames))
        recipe = load_recipe("scans", [*OPTIONS], Path(folder))
        done = hodge_pipeline.run(recipe, Path(folder) / "run", source=source)
    cpu_s = time.process_time() - begin
    used = done.edges.pairs[done.edges.status == USED]
    piece = connected_components(used, len(frames))
    i, j = np.triu_indices(len(frames), 1)
    same = world.place[i] == world.place[j]
    found = se3.inverse(done.poses[i]) @ done.poses[j]
    off = se3.inverse(se3.inverse(world.poses[i]) @ world.poses[j]) @ found
    near = np.linalg.norm(off[:, :3, 3], axis=1) < RIGHT_M * measured_scale(frames, 0.04)
    right = same & near & (np.linalg.norm(se3.so3_log(off[:, :3, :3]), axis=1) < np.radians(RIGHT_DEG))
    together = piece[i] == piece[j]
    counts = (together & right).sum(), (together & ~right).sum(), same.sum()
    return Outcome(*map(int, counts), len(np.unique(piece)), len(np.unique(world.place)), cpu_s)


def main() -> None:
    """Print a row for each world, all seeds together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--beams", type=int, default=32)
    parser.add_argument("--columns", type=int, default=480)
    options = parser.parse_args()
    print("| world | right | wrong | of | pieces | places | CPU s |\n|---|---|---|---|---|---|---|")
    for name in options.worlds:
        found = []
        for seed in options.seeds:
            world = WORLDS[name](seed)
            found.append(joined(world, scans(world, seed, options.beams, options.columns)))
        total = [sum(getattr(one, key) for one in found) for key in ("right", "wrong", "all_pairs", "pieces", "places")]
        print(f"| {name} | {' | '.join(map(str, total))} | {sum(one.cpu_s for one in found):.0f} |", flush=True)


if __name__ == "__main__":
    main()
