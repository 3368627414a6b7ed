"""Options of the data that a run reads, and of how it reads and saves."""

from __future__ import annotations

from typing import Literal, get_args

from spslam.options.needs import Need, is_, is_not, need
from spslam.options.section import Section, option

# Color and depth are of two cameras, or of two sizes.
TwoCameras = Literal[
    "rosbag",
    "realsense",
    "azure_kinect",
    "stray_scanner",
    "record3d",
    "scannetpp",
    "arkitscenes",
    "open3d",
    "video",
]
DatasetType = Literal[
    "generated",
    "places",
    "7scenes",
    "tum",
    "replica",
    "synthetic_rgbd",
    "scannet",
    "folder",
    TwoCameras,
    "bonn",
    "icl_nuim",
]
DATASET_TYPES: tuple[str, ...] = get_args(DatasetType)

_GENERATED = need(is_("dataset.type", "generated"))
_PLACES = need(is_("dataset.type", "places"))
_RENDERED = need(is_("dataset.type", "generated"), is_("dataset.type", "places"))


def _of(*types: str) -> tuple[Need, ...]:
    return (need(*(is_("dataset.type", name) for name in types)),)


_READ_FROM_FILES = (need(is_not("dataset.type", "generated")), need(is_not("dataset.type", "places")))
PlaceName = Literal["room", "apartment", "stairwell", "arcade", "desk", "hall"]
MotionName = Literal["handheld", "walking", "fast_turns", "stop_and_go"]
SensorName = Literal["exact", "structured_light", "stereo", "time_of_flight", "phone_lidar"]


class DatasetOptions(Section):
    """Which frames are read, and from where."""

    type: DatasetType = option(
        "format of the data; `generated` is a procedurally generated room and `places` are generated places with "
        "sensors and motions to choose; neither needs files"
    )
    path: str | None = option("folder of the data; `--data` overrides it", needs=_READ_FROM_FILES)
    stride: int = option("use every n-th frame", "frames", ge=1)
    min_depth_m: float = option("smaller depth is treated as missing", "m", ge=0)
    max_depth_m: float = option("larger depth is treated as missing", "m", gt=0, le=1000)
    border_px: int = option("depth within this distance of the image border is treated as missing", "px", ge=0, le=1000)
    mask: str | None = option(
        "image of the size of the recording's, black where depth is treated as missing, such as at a robot's own arm; "
        "null finds what moves along with the camera by frames of the whole recording, in files and bags; `none` uses "
        "all pixels"
    )
    sequence: str | int | None = option(
        "the sequence, `seq-03` or 3; `train` or `test` is the first of that split, null the first in the folder",
        needs=(need(is_("dataset.type", "7scenes")),),
    )
    depth_variant: Literal["filtered", "noisy", "exact"] | None = option(
        "depth images to read: noisy and filtered, noisy, or exact; null is the first of these in the folder",
        needs=(need(is_("dataset.type", "synthetic_rgbd")),),
    )
    depth_scale: float | None = option(
        "depth units per meter; null takes the value from the files",
        "1/m",
        needs=_of("folder", "rosbag", "realsense", "open3d", "video"),
        ge=1e-3,
        le=1e9,
    )
    register_to: Literal["depth", "color"] = option(
        "the camera to whose view color and depth of two cameras, or of two sizes, are brought; the trajectory is that "
        "camera's. `depth` leaves depth as it was measured",
        needs=_of("folder", *get_args(TwoCameras)),
    )
    registered: bool | None = option(
        "whether depth is in the color camera's view already; null finds out by the recording's frames, for `7scenes` "
        "by the camera: images of its Kinect are registered by a published calibration, others left as they are",
        needs=_of("rosbag", "realsense", "7scenes"),
    )
    pair_tolerance_s: float = option(
        "color and depth images are one frame if they are less apart in time; the nearest are paired first",
        "s",
        needs=_of("rosbag", "realsense", "azure_kinect", "arkitscenes", "video"),
        gt=0,
        le=10,
    )
    min_confidence: int = option(
        "depth of lower confidence is treated as missing: 0 none, 1 low, 2 low and medium (phones: ARKit's levels)",
        needs=_of("folder", "stray_scanner", "record3d", "arkitscenes"),
        ge=0,
        le=255,
    )
    color_topic: str | None = option("topic of color images; null finds it", needs=_of("rosbag"))
    depth_topic: str | None = option("topic of depth images; null finds it", needs=_of("rosbag"))
    pose_topic: str | None = option(
        "topic of reference poses (Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped); null takes the "
        "transforms",
        needs=_of("rosbag"),
    )
    world_frame: str | None = option(
        "frame in which the transforms give the reference poses; null is the root of the color camera's frame",
        needs=_of("rosbag"),
    )
    frames: int = option(
        "length of the sequence; the path is a loop (300 frames for `generated`), which is repeated as needed",
        "frames",
        needs=(_RENDERED,),
        ge=1,
    )
    width: int | None = option(
        "width of the images; null is 320 for `generated`, the sensor's for `places`", "px", needs=(_RENDERED,), ge=16
    )
    height: int | None = option(
        "height of the images; null is 240 for `generated`, the sensor's for `places`", "px", needs=(_RENDERED,), ge=16
    )
    noise: float = option(
        "0 is exact depth and noise-free color, 1 the noise and missing depth of a Kinect", needs=(_GENERATED,), ge=0
    )
    seed: int = option("seed of the place, the trajectory and the noise", needs=(_RENDERED,), ge=0, lt=2**63)
    place: PlaceName = option("the generated place", needs=(_PLACES,))
    motion: MotionName = option("how the camera is carried", needs=(_PLACES,))
    sensor: SensorName = option("the depth sensor, which also sets field of view and range", needs=(_PLACES,))
    texture: float = option(
        "contrast of all patterns and pictures; at 0 every surface has one plain color", needs=(_PLACES,), ge=0, le=1
    )
    people: int = option(
        "people who walk on the camera's way, in its images alone",
        needs=(_PLACES, need(is_not("dataset.place", "desk"))),
        ge=0,
        le=8,
    )
    rate_hz: float | None = option("frame rate; null is the sensor's", "Hz", needs=(_PLACES,), ge=1, le=120)
    sensor_noise: float = option(
        "scale of the sensor's errors: 0 is exact, 1 the sensor",
        needs=(_PLACES, need(is_not("dataset.sensor", "exact"))),
        ge=0,
        le=100,
    )
    color_noise: float = option(
        "standard deviation of color noise at middle gray, of 255 levels", "levels", needs=(_PLACES,), ge=0, le=255
    )
    exposure_ms: float = option(
        "exposure of color images, which blurs with motion", "ms", needs=(_PLACES,), ge=0, le=1000
    )
    auto_exposure: bool = option("brightness follows the scene's, and what is too bright is clipped", needs=(_PLACES,))
    rolling_shutter_ms: float = option(
        "read-out time from the first row of an image to the last", "ms", needs=(_PLACES,), ge=0, le=1000
    )
    color_delay_ms: float = option(
        "time from a frame's depth image to its color image", "ms", needs=(_PLACES,), ge=-1000, le=1000
    )
    color_rate_hz: float | None = option(
        "rate of a color camera that runs on its own; null takes a color image with each depth image",
        "Hz",
        needs=(_PLACES,),
        ge=1,
        le=120,
    )
    stamp_jitter_ms: float = option(
        "by up to how much each image's time stamp is late", "ms", needs=(_PLACES,), ge=0, le=1000
    )

    def check(self) -> None:
        if self.max_depth_m <= self.min_depth_m:
            raise ValueError(f"dataset.max_depth_m must be above dataset.min_depth_m, got {self.max_depth_m}")


class RunOptions(Section):
    """How frames are read and what is saved during a run."""

    checkpoint_every: int = option(
        "save a checkpoint every n frames, and every tenth of what is done where that is more; 0 saves none",
        "frames",
        ge=0,
    )
    prefetch_workers: int | None = option(
        "threads that read and decode images; null chooses by the number of cores and the device", "threads", ge=1
    )
    reader: Literal["auto", "process", "threads"] = option(
        "where these threads run: in a separate `process`, which forks one for each thread where frames are files of "
        "their own, or as `threads` of the run's own; `auto` is `process` for a GPU if the command line starts the run "
        "and the process can read the dataset. By `threads` a mesh reads its frames without other processes too"
    )
    graph_solver: Literal["auto", "process", "thread"] = option(
        "where the keyframe graph is solved: in a separate `process` or on a `thread` of the run's own, with the same "
        "result; `auto` is `process` for a GPU if the command line starts the run",
        needs=(need(is_("graph.enabled", True)),),
    )
    prefetch_ahead: int | None = option(
        "maximum number of frames read ahead; null is three per thread, at least 8", "frames", ge=1
    )
    data_check: Literal["stop", "warn", "skip"] = option(
        "what to do if the first frames plainly do not fit together (intrinsics, scale, pairing, order): `stop` ends "
        "the run before it begins, `warn` only says so, `skip` does not look"
    )
    previews: int = option("input frames saved as images for the report", "frames", ge=0)
