"""Every option of a run: its type, its unit, its range and what it does.

No number that a run uses stands here. ``configs/defaults.yaml`` holds a value for every option, a preset and a
configuration file change some of them, and :func:`spslam.config.load_config` merges the three.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

PresetName = Literal["paper", "balanced", "fast"]
DatasetType = Literal["generated", "7scenes", "tum", "replica", "synthetic_rgbd", "scannet", "folder"]
PRESETS: tuple[str, ...] = get_args(PresetName)
DATASET_TYPES: tuple[str, ...] = get_args(DatasetType)


def _option(description: str, unit: str | None = None, **limits: Any) -> Any:
    return Field(description=description, json_schema_extra={"unit": unit}, allow_inf_nan=False, **limits)


def _text(description: str, **limits: Any) -> Any:
    return Field(description=description, json_schema_extra={"unit": None}, **limits)


class Section(BaseModel):
    """A group of options: immutable, complete, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_validator(mode="after")
    def _check(self) -> Section:
        self.check()
        return self

    def check(self) -> None:
        """Raise ValueError where options that are valid one by one don't go together."""


class DatasetOptions(Section):
    """Which frames are read, and from where."""

    type: DatasetType = _text("layout of the data; `generated` is a room of spslam's own making that needs no files")
    path: str | None = _text("folder of the data; `--data` overrides it, `generated` needs none")
    stride: int = _option("use every n-th frame", "frames", ge=1)
    min_depth_m: float = _option("depth nearer than this counts as not measured", "m", ge=0)
    max_depth_m: float = _option("depth farther than this counts as not measured", "m", gt=0, le=1000)
    border_px: int = _option("depth this close to the image's border counts as not measured", "px", ge=0, le=1000)
    sequence: str | int | None = _text(
        "7scenes: the sequence, `seq-03` or 3; `train` or `test` is the first of that split, null the first there is"
    )
    depth_variant: Literal["filtered", "noisy", "exact"] | None = _text(
        "synthetic_rgbd: depth with filtered noise, with noise, or exact; null is the first that is there"
    )
    depth_scale: float | None = _option("folder: depth units a meter; null is what the files say", "1/m", gt=0)
    frames: int = _option("generated: length of the sequence; 300 go round the room once", "frames", ge=1)
    width: int = _option("generated: width of the images", "px", ge=16)
    height: int = _option("generated: height of the images", "px", ge=16)
    noise: float = _option("generated: 0 is exact depth and clean color, 1 the noise and holes of a Kinect", ge=0)
    seed: int = _option("generated: seed of the room, the path and the noise", ge=0)

    def check(self) -> None:
        if self.max_depth_m <= self.min_depth_m:
            raise ValueError(f"dataset.max_depth_m must be above dataset.min_depth_m, got {self.max_depth_m}")


class SceneOptions(Section):
    """The map: sparse volume, tri-planes and the system's frame of reference."""

    voxel_size_m: float = _option("edge of a voxel of the sparse volume", "m", gt=0, le=1)
    truncation_m: float = _option("truncation distance tr of the signed distance", "m", gt=0, le=4)
    plane_cell_m: float = _option("edge of a cell of the feature planes", "m", gt=0, le=4)
    position_scale: float = _option("factor from meters to the position the geometry decoder is given", "1/m", gt=0)
    first_pose: Literal["dataset", "identity"] = _text(
        "pose of the first frame: the data set's where it has one, or the identity"
    )
    max_voxels: int = _option("most voxel vertices the volume may hold", "vertices", ge=1000)
    max_texels: int = _option("most texels the three feature planes may hold", "texels", ge=1000)

    def check(self) -> None:
        if self.truncation_m < self.voxel_size_m:
            raise ValueError(f"scene.truncation_m must be at least scene.voxel_size_m, got {self.truncation_m}")


class SamplingOptions(Section):
    """Samples along a ray (section III.B)."""

    uniform: int = _option("N_c, samples spread between near and far", "samples", ge=0, le=128)
    surface: int = _option("N_f, samples within the truncation distance of the measured depth", "samples", ge=1, le=128)
    near: float = _option("n_1, start of the ray as a share of the measured depth", ge=0)
    far: float = _option("n_2, end of the ray as a share of the measured depth", gt=0)

    def check(self) -> None:
        if self.far <= self.near:
            raise ValueError(f"sampling.far must be above sampling.near, got {self.far}")


class LossOptions(Section):
    """Weights of the objective (7) and the reading of its geometric targets."""

    rgb: float = _option("lambda_rgb, weight of the color loss (8)", ge=0)
    depth: float = _option("lambda_depth, weight of the rendered depth loss (9)", ge=0)
    free_space: float = _option("lambda_fs, weight of the free-space loss (11)", ge=0)
    sdf: float = _option("lambda_sdf, weight of the signed distance loss (10)", ge=0)
    cosine_targets: bool = _text(
        "scale the distance along the ray by the cosine between ray and surface normal, instead of (10) as written"
    )


class TrackingOptions(Section):
    """Pose of each frame against the map as it is (section III.D)."""

    optimizer: Literal["adam", "gauss_newton"] = _text(
        "`adam` on quaternion and translation as in the paper, or `gauss_newton` on the signed distance"
    )
    iterations: int = _option("I_t, iterations a frame", "iterations", ge=1)
    first_iterations: int = _option("iterations of each of the first frames", "iterations", ge=1)
    first_frames: int = _option("how many frames get `first_iterations`", "frames", ge=0)
    pixels: int = _option("M_t, pixels drawn anew each iteration", "px", ge=16)
    rotation_rate: float = _option("adam: learning rate of the quaternion", ge=0)
    translation_rate: float = _option("adam: learning rate of the translation", "m", ge=0)
    kernel_start_m: float = _option("gauss_newton: width of the robust kernel in the first iteration", "m", gt=0)
    kernel_end_m: float = _option("gauss_newton: width of the robust kernel in the last iteration", "m", gt=0)
    damping: float = _option("gauss_newton: share of its diagonal added to the normal matrix", ge=0)
    noise_crossover_depth_m: float = _option(
        "gauss_newton: depth at which noise that grows with its square equals the map's; 0 weighs all alike", "m", ge=0
    )
    color_weight_m: float = _option(
        "gauss_newton: what a difference in brightness from black to white to the last mapped frame counts as; 0 "
        "compares no colors",
        "m",
        ge=0,
    )
    color_kernel: float = _option("gauss_newton: width of the robust kernel of brightness, of which white is 1", gt=0)
    depth_keyframes: bool = _option(
        "gauss_newton: hold a frame also against the depth images of the last one, one 10 and one 40 frames back"
    )
    depth_keyframe_kernel_m: float = _option(
        "gauss_newton: width of the robust kernel of distances from these images in the last iteration", "m", gt=0
    )
    rescue: bool = _option(
        "start anew from projective ICP where a frame fits the map badly; with adam only where it is lost"
    )
    recovery_min_robust_weight: float = _option(
        "rescue where the mean robust weight of the pixels is below this", ge=0, le=1
    )
    verify_threshold: float = _option(
        "verify a pose, and try others, where the doubt about it is above this (docs/tracking-failure.md)", ge=0, le=1
    )
    lost_threshold: float = _option("a frame is lost where the doubt about its pose stays above this", ge=0, le=1)
    relocalization_threshold: float = _option(
        "the doubt must be below this where a camera is found again after loss", ge=0, le=1
    )
    relocalization_candidates: int = _option(
        "stored frames that a lost frame is laid onto, the likest ones; 0 looks for none", "frames", ge=0
    )
    min_inlier_share: float = _option("a frame with a smaller share of pixels on mapped surface is lost", ge=0, le=1)
    min_valid_depth_share: float = _option("a frame with depth in a smaller share of its image is lost", ge=0, le=1)

    def check(self) -> None:
        if self.kernel_end_m > self.kernel_start_m:
            raise ValueError(f"tracking.kernel_end_m must be at most tracking.kernel_start_m, got {self.kernel_end_m}")


class MappingOptions(Section):
    """Joint optimization of the map and the poses of chosen frames (section III.D)."""

    every: int = _option("map after this many frames", "frames", ge=1)
    iterations: int = _option("I_m, iterations each time", "iterations", ge=0)
    first_iterations: int = _option("iterations on the first frame", "iterations", ge=0)
    pixels: int = _option("M_p, pixels drawn each iteration from all chosen frames together", "px", ge=16)
    frames: int = _option("frames chosen each time: recent, co-visible, and the rest at random", "frames", ge=1)
    recent: int = _option("how many of them are the most recent", "frames", ge=1)
    covisible: int = _option("how many of them are drawn from the co-visible ones", "frames", ge=0)
    covisibility_threshold: float = _option(
        "least share of the current frame's points that a co-visible frame sees", ge=0, le=1
    )
    embedding_rate: float = _option("learning rate of the voxel embeddings", ge=0)
    plane_rate: float = _option("learning rate of the feature planes", ge=0)
    decoder_rate: float = _option("learning rate of the geometry decoder", ge=0)
    color_decoder_rate: float = _option("learning rate of the color decoder", ge=0)
    pose_rate: float = _option("learning rate of the poses", ge=0)
    optimize_poses: bool = _text("optimize the chosen frames' poses together with the map")
    optimize_geometry: bool = _text("optimize embeddings and geometry decoder; false leaves geometry to fusion (1)")
    reset_moments: bool = _text("start Adam's moments anew each time mapping runs")

    def check(self) -> None:
        if self.recent + self.covisible > self.frames:
            raise ValueError(
                f"mapping.frames must be at least mapping.recent + mapping.covisible "
                f"({self.recent + self.covisible}), got {self.frames}"
            )


class PixelOptions(Section):
    """The pixel database that mapping draws from."""

    per_frame: int = _option("M_k, pixels kept of each frame", "px", ge=16)
    keyframe_every: int = _option(
        "keep only every n-th frame, and the newest while it is that; 1 keeps all, as the paper does", "frames", ge=1
    )
    budget_mb: float = _option("memory for them; past it old frames are thinned evenly", "MB", gt=0)


class PriorOptions(Section):
    """The depth encoder and its fusion into the volume (section III.A)."""

    enabled: bool = _text("encode each mapped frame and fuse it; false starts new voxels from random embeddings")
    fusion: bool = _text("fuse into voxels that are there already (1); false only fills new ones")
    weights: str | None = _text(
        "file of encoder and decoder weights (safetensors); null is the one shipped for the neighborhood"
    )
    decoder: Literal["pretrained", "random"] = _text(
        "start of the geometry decoder: the one trained with the encoder, or random numbers"
    )
    neighborhood: Literal[8, 64] = _option("voxel corners around a point that it is encoded at", "corners")
    points_per_frame: int = _option("most points of a frame that are encoded", "points", ge=1)
    min_weight: float = _option("least weight of a point at a corner", ge=0)
    kappa: float = _option("sum of point weights at which a corner's weight W_m reaches 1", gt=0)
    max_weight: float = _option("cap of the fused weight W_g", gt=0)
    normal_step_px: int = _option("distance of the differences that give the normals", "px", ge=1)
    max_jump: float = _option("depth step between neighbors, as a share of the depth, that is an edge", gt=0)


class MeshOptions(Section):
    """The mesh written at the end."""

    resolution_m: float = _option("edge of a marching-cubes cell", "m", gt=0, le=1)


class RunOptions(Section):
    """How the frames are read and what is kept on the way."""

    checkpoint_every: int = _option("save the state to resume from after this many frames; 0 never", "frames", ge=0)
    prefetch_workers: int | None = _option(
        "threads that read and decode images; null is as many as suit the cores and the device", "threads", ge=1
    )
    reader: Literal["auto", "process", "threads"] = _text(
        "where those threads are: in a `process` of their own, so that they don't hold up the loop, or the run's; "
        "`auto` is the first for a GPU where the command line starts the run"
    )
    prefetch_ahead: int | None = _option("most frames read ahead; null is two a thread", "frames", ge=1)
    previews: int = _option("input frames kept as pictures for the report", "frames", ge=0)


class Config(Section):
    """All options of a run, resolved: every one has a value."""

    preset: PresetName = _text("the preset that was merged in")
    seed: int = _option("key of all random draws", ge=0, lt=2**63)
    device: str = _text(
        "`cpu`, `cuda`, `cuda:N`, or `auto`, which is the GPU if there is one", pattern=r"^(auto|cpu|cuda(:\d+)?)$"
    )
    precision: Literal["tf32", "fp32"] = _text(
        "cuda: how networks multiply while tracking (adam), encoding and mapping, `tf32` on matrix units or `fp32`"
    )
    dataset: DatasetOptions
    scene: SceneOptions
    sampling: SamplingOptions
    loss: LossOptions
    tracking: TrackingOptions
    mapping: MappingOptions
    pixels: PixelOptions
    prior: PriorOptions
    mesh: MeshOptions
    run: RunOptions
