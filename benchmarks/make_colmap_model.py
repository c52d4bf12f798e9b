"""Makes a real COLMAP model of a folder of images, with its database, by pycolmap on the CPU.

    python benchmarks/make_colmap_model.py redkitchen/seq-01 OUT --every 10 --camera 525 525 320 240

OUT then holds what a COLMAP user has side by side: `images/`, `depth/` (where the folder has depth), `database.db` and
`sparse/0`, `sparse/1`, …; names are kept, so the depth of an image is found by its name.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import pycolmap

COLOUR = (".color.jpg", ".color.png", ".jpg", ".jpeg", ".png")
DEPTH = ".depth.png"


def colour_images(folder: Path) -> list[Path]:
    """The colour images of a folder in the order of their names."""
    found = sorted(path for path in folder.iterdir() if path.name.lower().endswith(COLOUR))
    return [path for path in found if not path.name.endswith(DEPTH)]


def copy_inputs(paths: Sequence[Path], out: Path) -> int:
    """Copies images and the depth beside them, names kept; how many have depth."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    found = 0
    for path in paths:
        shutil.copyfile(path, out / "images" / path.name)
        depth = path.with_name(path.name.split(".")[0] + DEPTH)
        if depth.is_file():
            (out / "depth").mkdir(exist_ok=True)
            shutil.copyfile(depth, out / "depth" / depth.name)
            found += 1
    return found


def match(
    out: Path, camera: Sequence[float] | None = None, *, model: str = "SIMPLE_RADIAL", features: int = 4000
) -> None:
    """Extracts features of `out/images` and matches every pair into `out/database.db`."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE" if camera else model
    if camera:
        reader.camera_params = ",".join(map(str, camera))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.sift.max_num_features = features
    database = out / "database.db"
    database.unlink(missing_ok=True)
    pycolmap.extract_features(
        database, out / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def reconstruct(out: Path, *, refine_camera: bool = False, min_model_size: int = 3) -> int:
    """Runs incremental mapping on the database into `out/sparse`; how many models it gave."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads, options.min_model_size = 0, 1, min_model_size
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine_camera
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine_camera
    (out / "sparse").mkdir(exist_ok=True)
    return len(pycolmap.incremental_mapping(out / "database.db", out / "images", out / "sparse", options))


def make_model(
    paths: Sequence[Path],
    out: Path,
    camera: Sequence[float] | None = None,
    *,
    refine_camera: bool = False,
    features: int = 4000,
) -> int:
    """A model of these images in `out`, see the module; how many parts it fell into.

    `camera`: fx fy cx cy; none: a SIMPLE_RADIAL camera that is refined.
    """
    copy_inputs(paths, out)
    match(out, camera, features=features)
    return reconstruct(out, refine_camera=refine_camera or camera is None)


def main() -> None:
    """Make the model and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every n-th image of the folder")
    parser.add_argument("--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), default=None)
    parser.add_argument("--refine-camera", action="store_true", help="let COLMAP refine what --camera gives")
    parser.add_argument("--features", type=int, default=4000, help="SIFT features of an image at most")
    options = parser.parse_args()
    paths = colour_images(options.images)[:: options.every]
    make_model(paths, options.out, options.camera, refine_camera=options.refine_camera, features=options.features)
    for folder in sorted((options.out / "sparse").iterdir()):
        model = pycolmap.Reconstruction(folder)
        print(
            f"{folder}: {model.num_reg_images()} of {len(paths)} images, {model.num_points3D()} points, "
            f"{model.compute_mean_reprojection_error():.3f} px, mean track {model.compute_mean_track_length():.2f}"
        )


if __name__ == "__main__":
    main()
