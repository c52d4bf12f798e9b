"""Good data for each reader, to be damaged: see `fuzz_readers`."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType

from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.nerfstudio import NerfstudioReader, NerfstudioWriter
from hodge_adapters.open3d_json import Open3dPoseGraphWriter, Open3dReader, Open3dTrajectoryWriter
from hodge_adapters.pose_graphs.g2o import G2oReader, G2oWriter
from hodge_adapters.pose_graphs.pair_log import PairLogReader
from hodge_adapters.pose_graphs.toro import ToroReader
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.trajectories.euroc import EurocReader, EurocWriter
from hodge_adapters.trajectories.log import LogReader, LogWriter
from hodge_adapters.trajectories.positions import PositionsReader
from hodge_adapters.trajectories.readers import KittiPosesReader, TumPosesReader
from hodge_adapters.trajectories.text import KittiWriter, TumWriter
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.types import Camera, Frame, PointCloud, Source, Trajectory, ViewGraph
from mcap_data import some_images, write_depth_log
from mcap_encoding import CDR, JSON, PROTOBUF
from mcap_scene import everything
from readers_data import seven_scenes_sequence, some_poses, tum_folder, tum_line, write_colour, write_depth
from scan_data import FAR, ROOM, write_e57, write_las


@dataclass(frozen=True)
class Target:
    """A reader, what makes good data for it and gives the path to open, and how many images of that are refused."""

    reader: FrameReader
    make: Callable[[Path], Path]
    refused: int = 0


def poses_source(count: int = 4) -> Source:
    poses = some_poses(count)
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    frames = tuple(Frame(f"{row}.png", float(row), camera, world_from_cam=pose) for row, pose in enumerate(poses))
    edges = np.array([(row, row + 1) for row in range(count - 1)])
    graph = ViewGraph.from_edges(np.arange(count), edges, se3.inverse(poses[:-1]) @ poses[1:])
    return Source("made", Path("made"), frames, Trajectory(np.arange(count) + 100.5, poses), graph)


def written(writer: object, name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        writer.write(folder / name, poses_source())
        return folder / name

    return make


def icl(folder: Path) -> Path:
    for number in range(1):
        write_depth(folder / f"depth/{number}.png", np.full((6, 8), 5000, np.uint16))
        write_colour(folder / f"rgb/{number}.png", size=(6, 8))
    (folder / "associations.txt").write_text("".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in range(1)))
    (folder / "a.gt.freiburg").write_text("".join(tum_line(n, pose) for n, pose in enumerate(some_poses(3))))
    return folder


def pov(folder: Path) -> Path:
    text = "cam_pos = [1, 2, 3]';\ncam_dir = [0, 0, 1]';\ncam_up = [0, 1, 0]';\ncam_right = [1.33, 0, 0]';\n"
    for number in range(2):
        stem = folder / f"scene_00_{number:04d}"
        stem.with_suffix(".txt").write_text(text)
        stem.with_suffix(".depth").write_text("1.5 " * 48)
        write_colour(stem.with_suffix(".png"))
    return folder


def redwood(folder: Path) -> Path:
    for number in range(1):
        write_depth(folder / f"depth/{number:05d}.png", np.full((6, 8), 1000, np.uint16))
        write_colour(folder / f"image/{number:05d}.jpg", size=(6, 8))
    LogWriter().write(
        folder / "trajectory.log", Source("a", folder, trajectory=Trajectory(np.arange(3.0), some_poses(3)))
    )
    return folder


def pairs(folder: Path) -> Path:
    some = some_poses(3)
    graph = ViewGraph.from_edges(np.arange(3), np.array([[0, 1], [1, 2], [2, 0]]), np.stack(list(some)))
    LogWriter().write(folder / "a.log", Source("pairs", folder, graph=graph))
    return folder / "a.log"


def toro(folder: Path) -> Path:
    lines = [
        "VERTEX2 0 0 0 0",
        "VERTEX2 1 1 0 0.1",
        "EDGE2 0 1 1 0 0.1 500 0 500 5000 0 0",
        "EDGE2 1 0 -1 0 -0.1 500 0 500 5000 0 0",
    ]
    (folder / "a.graph").write_text("\n".join(lines) + "\n")
    return folder / "a.graph"


def colmap(form: str, points: int = 0) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import pycolmap

        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
        options.num_points3D = points or 5
        pycolmap.set_random_seed(0)
        base = pycolmap.Database.open(folder / "database.db") if points else None
        model = pycolmap.synthesize_dataset(options, base) if base else pycolmap.synthesize_dataset(options)
        if base:
            base.close()
        (folder / "sparse").mkdir()
        (model.write_text if form == "txt" else model.write_binary)(folder / "sparse")
        for image in model.images.values():
            write_depth(folder / "depth" / image.name, np.full((768 // 64, 1024 // 64), 1000, np.uint16))
        return folder

    return make


def colmap_depth(stereo: bool) -> Callable[[Path], Path]:
    """Two cameras of a rig, with sensor depth beside the images, or COLMAP's own depth maps."""

    def make(folder: Path) -> Path:
        import pycolmap

        options = pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=20
        )
        options.camera_width, options.camera_height = 8, 6
        options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
        options.camera_params = [10.0, 4.0, 3.0, 0.01]
        pycolmap.set_random_seed(0)
        model = pycolmap.synthesize_dataset(options)
        (folder / "sparse").mkdir()
        model.write_binary(folder / "sparse")
        for image in model.images.values():
            if stereo:
                path = folder / f"stereo/depth_maps/{image.name}.geometric.bin"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(b"8&6&1&" + struct.pack("<48f", *np.linspace(1, 2, 48)))
            else:
                write_depth(folder / f"depth/{image.name}", np.full((6, 8), 1500, np.uint16))
        return folder

    return make


def mcap_of(encoding: str) -> Callable[[Path], Path]:
    """Every kind of message without compression and checksums, so that damage reaches what reads them."""

    def make(folder: Path) -> Path:
        return everything(encoding).write(
            folder / "a.mcap", CompressionType.NONE, enable_crcs=False, enable_data_crcs=False
        )

    return make


def bag_of(kind: str) -> Callable[[Path], Path]:
    """Every kind of message, by the writers of another library."""

    def make(folder: Path) -> Path:
        from bag_data import WRITERS  # skips where that library is absent

        return WRITERS[kind](everything(), folder)

    return make


def split_bag(folder: Path) -> Path:
    for row in range(2):
        write_depth_log(folder / f"bag_{row}.mcap", some_images(1))
    names = "".join(f"  - bag_{row}.mcap\n" for row in range(2))
    text = f"rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n{names}"
    (folder / "metadata.yaml").write_text(text)
    return folder


def fragments(folder: Path) -> Path:
    """Two fragments with a log of poses and a pair."""
    for row in range(2):
        write_ply(folder / f"cloud_{row}.ply", PointCloud(np.ones((4, 3), np.float32)))
    poses = some_poses(2)
    graph = ViewGraph.from_edges(np.arange(2), np.array([[0, 1]]), se3.inverse(poses[:1]) @ poses[1:])
    LogWriter().write(folder / "a.log", Source("a", folder, graph=graph))
    return folder


def scene(folder: Path) -> Path:
    """Two sequences, of which the split takes both."""
    for name in ("seq-01", "seq-02"):
        (seven_scenes_sequence(folder / name, 1) / "camera-intrinsics.txt").rename(folder / "camera-intrinsics.txt")
    (folder / "TrainSplit.txt").write_text("sequence1\r\nsequence2\r\n")
    return folder


def pairs_with_information(folder: Path) -> Path:
    path = pairs(folder)
    matrix = "".join(" ".join(map(str, row)) + "\n" for row in np.diag([5.0, 5, 5, 9, 9, 9]))
    path.with_suffix(".info").write_text("".join(f"{i} {j} 3\n{matrix}" for i, j in ((0, 1), (1, 2), (2, 0))))
    return path


def ply(ascii: bool) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        cloud = PointCloud(np.random.default_rng(0).normal(0, 1, (8, 3)).astype(np.float32))
        write_ply(folder / "cloud_0.ply", cloud)
        if ascii:
            header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            (folder / "cloud_0.ply").write_text(header + "end_header\n1 2 3\n4 5 6\n7 8 9\n")
        pose = Trajectory(np.zeros(1), some_poses(1))
        LogWriter().write(folder / "all.log", Source("a", folder, trajectory=pose))
        return folder

    return make


def uos(folder: Path) -> Path:
    (folder / "scan000.3d").write_text("2 x 1\n1 2 3\n4 5 6\n")
    (folder / "scan000.pose").write_text("0 0 100\n0 90 0\n")
    return folder


def vtk(kind: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        points = b"1 2 3 4 5 6" if kind == "ASCII" else struct.pack(">6f", *range(6))
        head = f"# vtk DataFile Version 3.0\nmade\n{kind}\nDATASET POLYDATA\nPOINTS 2 float\n"
        (folder / "a.vtk").write_bytes(head.encode() + points + b"\nVERTICES 1 3\n2 0 1\n")
        return folder

    return make


def las(folder: Path) -> Path:
    write_las(folder / "a.las", FAR + ROOM)
    return folder


def planar(folder: Path) -> Path:
    """A graph in the plane with a vertex that is held and what is known of another."""
    path = folder / "planar.g2o"
    path.write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.5\nVERTEX_SE2 2 1 1 1.5\nFIX 0\nEDGE_SE2 0 1 1 0 0.5 4 0 0 4 0 9\n"
        "EDGE_SE2 1 2 0.5 0.9 1 4 0 0 4 0 9\nEDGE_PRIOR_SE2 1 1 0 0.5 4 0 0 4 0 9\nEDGE_PRIOR_SE2_XY 2 1 1 4 0 4\n"
    )
    return path


def priors(folder: Path) -> Path:
    """A graph in space whose vertices are known in part, one by a sensor with an offset."""
    path = folder / "priors.g2o"
    information = " ".join(map(str, np.eye(6)[np.triu_indices(6)]))
    G2oWriter().write(path, poses_source())
    known = f"0 0 0 0 0 0 1 {information}\n"
    path.write_text(
        f"{path.read_text()}PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1\nEDGE_SE3_PRIOR 1 0 {known}EDGE_SE3_PRIOR 2 0 {known}"
    )
    return path


def fixes(folder: Path) -> Path:
    path = folder / "fixes.csv"
    path.write_text("name,lat,lon,alt,sigma,cov_ee\na,49,8,100,0.5,1\nb,49.1,8,100,0.5,1\n12,49,8.2,90,,\n")
    return path


def isam(folder: Path) -> Path:
    path = folder / "isam.txt"
    path.write_text("ODOMETRY 0 1 1 0 0.1 4 0 0 9 0 1\nLANDMARK 0 5 2 3 0.4 0 0.4\nODOMETRY 1 2 1 0 0.1 4 0 0 9 0 1\n")
    return path


def pcd(kind: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        points = np.arange(24, dtype="<f4").reshape(8, 3)
        body = (
            "\n".join(" ".join(map(str, row)) for row in points).encode() + b"\n"
            if kind == "ascii"
            else points.tobytes()
        )
        if kind == "binary_compressed":
            raw = points.T.tobytes()
            packed = b"".join(bytes([len(raw[at : at + 32]) - 1]) + raw[at : at + 32] for at in range(0, len(raw), 32))
            body = np.array([len(packed), len(raw)], "<u4").tobytes() + packed
        header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 8\nHEIGHT 1\nPOINTS 8\n"
        (folder / "a.pcd").write_bytes(f"{header}DATA {kind}\n".encode() + body)
        return folder

    return make


TARGETS: dict[str, Target] = {
    "seven_scenes": Target(SevenScenesReader(), lambda folder: seven_scenes_sequence(folder / "seq-01", 2)),
    "tum": Target(TumReader(), tum_folder),
    "icl_lists": Target(IclNuimReader(camera=(10.0, -10.0, 4.0, 3.0)), icl),
    "icl_pov": Target(IclNuimReader(camera=(10.0, -10.0, 4.0, 3.0)), pov),
    "icl_redwood": Target(IclNuimReader(camera=(10.0, 10.0, 4.0, 3.0)), redwood),
    "seven_scenes_split": Target(SevenScenesReader(split="train", colour_camera="kinect"), scene),
    "mcap_ros": Target(McapReader(), mcap_of(CDR)),
    "mcap_protobuf": Target(McapReader(depth_topic="/rvl"), mcap_of(PROTOBUF)),
    "mcap_json": Target(McapReader(depth_topic="/png"), mcap_of(JSON)),
    "mcap_clouds": Target(McapReader(frames="points"), mcap_of(CDR)),
    "db3": Target(McapReader(), bag_of("db3 before Iron")),
    "bag": Target(McapReader(), bag_of("bag")),
    "bag_bz2": Target(McapReader(frames="points"), bag_of("bag bz2")),
    "mcap_split": Target(McapReader(), split_bag),
    "mcap": Target(McapReader(), lambda folder: write_depth_log(folder / "a.mcap", some_images(2))),
    "colmap_bin": Target(ColmapReader(edges="none"), colmap("bin")),
    "colmap_txt": Target(ColmapReader(edges="none"), colmap("txt")),
    "colmap_database": Target(ColmapReader(edges="database", min_shared=8), colmap("bin", 12)),
    "colmap_sensor": Target(ColmapReader(edges="none"), colmap_depth(stereo=False)),
    "colmap_stereo": Target(ColmapReader(edges="none"), colmap_depth(stereo=True)),
    "fragments": Target(CloudFolderReader(), fragments),
    "ply_binary": Target(CloudFolderReader(), ply(False)),
    "ply_ascii": Target(CloudFolderReader(), ply(True)),
    "pcd_ascii": Target(CloudFolderReader(), pcd("ascii")),
    "pcd_binary": Target(CloudFolderReader(), pcd("binary")),
    "pcd_compressed": Target(CloudFolderReader(), pcd("binary_compressed")),
    "nerfstudio": Target(NerfstudioReader(), written(NerfstudioWriter(), "transforms.json")),
    "open3d_graph": Target(Open3dReader(), written(Open3dPoseGraphWriter(), "graph.json")),
    "open3d_cameras": Target(Open3dReader(), written(Open3dTrajectoryWriter(), "cameras.json")),
    "euroc": Target(EurocReader(), written(EurocWriter(), "data.csv")),
    "log": Target(LogReader(), written(LogWriter(), "a.log")),
    "pair_log": Target(PairLogReader(), pairs),
    "positions": Target(PositionsReader(), fixes),
    "pair_information": Target(PairLogReader(), pairs_with_information),
    "tum_poses": Target(TumPosesReader(), written(TumWriter(), "a.tum")),
    "kitti_poses": Target(KittiPosesReader(), written(KittiWriter(), "a.txt")),
    "g2o": Target(G2oReader(), written(G2oWriter(), "a.g2o")),
    "g2o_planar": Target(G2oReader(), planar),
    "g2o_priors": Target(G2oReader(), priors),
    "isam": Target(ToroReader(), isam),
    "las": Target(CloudFolderReader(), las),
    "e57": Target(CloudFolderReader(), lambda folder: write_e57(folder / "a.e57", some_poses(2))),
    "toro": Target(ToroReader(), toro),
    "uos": Target(CloudFolderReader(), uos),
    "vtk_ascii": Target(CloudFolderReader(), vtk("ASCII")),
    "vtk_binary": Target(CloudFolderReader(), vtk("BINARY")),
}
