"""Options of global registration for initial poses."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.pairs.drift import DriftEdges
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.global_landmarks import LandmarkConsensus
from hodge_pipeline.registration.global_registrars import FpfhConsensus
from hodge_pipeline.stages import OPTIONS, EdgeBuilder, GlobalRegistrar, Registrar


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class HypothesisLimits:
    """Which hypotheses become edges that the diagnosis judges; the others are counted, each with its reason."""

    min_inliers: int = Field(default=15, ge=4, description="matches that agree; by chance up to about ten do")
    min_overlap: float = Field(
        default=0.2, ge=0, le=1, description="share of the smaller cloud with a point of the other nearby"
    )
    max_rmse_m: float = Field(default=0.06, gt=0, description="metres: RMS distance of those points")
    room_m: float = Field(
        default=1.0, gt=0, description="metres: a metre of a room in this scene, for the margins of depth images"
    )


@dataclass(frozen=True, config=OPTIONS)
class GlobalStart:
    """How frames or scans in no order are joined."""

    use: Literal["auto", "images", "geometry"] = Field(
        default="auto",
        description="what pairs are matched by; auto: images where at least half of the clouds have landmarks",
    )
    registrar: GlobalRegistrar = Field(default=FpfhConsensus(), description="how two clouds are matched by geometry")
    images: GlobalRegistrar = Field(default=LandmarkConsensus(), description="how two frames are matched by image")
    refine: Registrar = Field(
        default=Gicp(distances_m=(0.1, 0.05), source_points=(2000, 4000)),
        description="how a match is refined before it is judged",
    )
    all_pairs_up_to: int = Field(
        default=30, ge=0, description="frames: up to so many every pair is tried, beyond it the most similar ones"
    )
    similar_per_frame: int = Field(
        default=12,
        ge=0,
        description="the most similar frames, by global descriptors, that each frame is matched with; 0: none, after "
        "odometry that drifts little, which leaves out whatever looks alike elsewhere",
    )
    reach: int = Field(
        default=5,
        ge=1,
        description="frames: after odometry, of so many consecutive ones only the most similar is matched, and none so "
        "near, since odometry has joined them",
    )
    loops: tuple[EdgeBuilder, ...] = Field(
        default=(DriftEdges(),),
        description="after odometry, who names further pairs to match: drift, what poses bring together with a "
        "tolerance that grows along the trajectory; place, scans that look alike, wherever the poses have drifted to",
    )
    landmarks: int = Field(
        default=1000, ge=15, description="landmarks of a frame, where `clouds.landmarks` leaves it to the start; 60 ms"
    )
    limits: HypothesisLimits = Field(default=HypothesisLimits(), description="which matches become edges")
    diagnosis: DiagnosisOptions = Field(
        default=DiagnosisOptions(order_prior=False),
        description="who judges the edges together; the order of the frames is no evidence here",
    )
    words: int = Field(default=32, ge=1, description="words of the global descriptors' vocabulary")
    seed: int = Field(default=0, ge=0, description="of the vocabulary's sample")
