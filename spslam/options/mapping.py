"""Options of rendering, its loss, and the optimization of the map."""

from __future__ import annotations

from spslam.options.needs import Need, above, is_, need
from spslam.options.section import Section, option

_ADAM = is_("tracking.optimizer", "adam")
_SOME_ITERATIONS = (above("mapping.iterations", 0), above("mapping.first_iterations", 0))
_OPTIMIZES_GEOMETRY = is_("mapping.optimize_geometry", True)
_OPTIMIZES_POSES = is_("mapping.optimize_poses", True)

_MAPPING = Need(_SOME_ITERATIONS, documented_by_section=True)
_RENDERING = Need((*_SOME_ITERATIONS, _ADAM), documented_by_section=True)
_GEOMETRY = need(_OPTIMIZES_GEOMETRY)
_POSES = need(_OPTIMIZES_POSES)
_COLOR = need(above("loss.rgb", 0))
_UNIFORM = need(above("sampling.uniform", 0))
# The geometric losses have no gradient with respect to the tri-planes and the color decoder.
_SHAPE = need(_OPTIMIZES_GEOMETRY, _OPTIMIZES_POSES, _ADAM)


class SamplingOptions(Section):
    """Samples along a ray (section III.B).

    Rays are rendered by mapping with at least one iteration, and by tracking with `adam`.
    """

    uniform: int = option("N_c, samples between near and far", "samples", needs=(_RENDERING,), ge=0, le=128)
    surface: int = option(
        "N_f, samples within the truncation distance of the measured depth",
        "samples",
        needs=(_RENDERING,),
        ge=1,
        le=128,
    )
    near: float = option(
        "n_1, start of the ray as a fraction of the measured depth", needs=(_RENDERING, _UNIFORM), ge=0
    )
    far: float = option("n_2, end of the ray as a fraction of the measured depth", needs=(_RENDERING, _UNIFORM), gt=0)

    def check(self) -> None:
        if self.far <= self.near:
            raise ValueError(f"sampling.far must be above sampling.near, got {self.far}")


class LossOptions(Section):
    """Weights of the loss, eq. (7), and its geometric targets.

    The loss is minimized by mapping with at least one iteration, and by tracking with `adam`.
    """

    rgb: float = option("lambda_rgb, weight of the color loss, eq. (8)", needs=(_RENDERING,), ge=0)
    depth: float = option("lambda_depth, weight of the depth loss, eq. (9)", needs=(_RENDERING, _SHAPE), ge=0)
    free_space: float = option("lambda_fs, weight of the free-space loss, eq. (11)", needs=(_RENDERING, _SHAPE), ge=0)
    sdf: float = option("lambda_sdf, weight of the SDF loss, eq. (10)", needs=(_RENDERING, _SHAPE), ge=0)
    cosine_targets: bool = option(
        "multiply the distance along the ray by the cosine between ray and surface normal; false is eq. (10)",
        needs=(_RENDERING, _SHAPE),
    )


class MappingOptions(Section):
    """Joint optimization of the map and the poses of selected frames (section III.D).

    With 0 `iterations` and 0 `first_iterations` nothing is optimized: frames are encoded and fused. Of these options
    only `every` has an effect.
    """

    every: int = option("map every n-th frame", "frames", ge=1)
    iterations: int = option("I_m, iterations per mapped frame", "iterations", ge=0)
    first_iterations: int = option("iterations on the first frame", "iterations", ge=0)
    pixels: int = option(
        "M_p, pixels drawn in each iteration from all selected frames together",
        "px",
        needs=(_MAPPING,),
        ge=16,
        le=2**20,
    )
    frames: int = option(
        "maximum number of selected frames: recent and co-visible ones, the rest at random",
        "frames",
        needs=(_MAPPING,),
        ge=1,
    )
    recent: int = option("how many of them are the most recent", "frames", needs=(_MAPPING,), ge=1)
    covisible: int = option("how many of them are co-visible", "frames", needs=(_MAPPING,), ge=0)
    covisibility_threshold: float = option(
        "minimum fraction of the current frame's points that a co-visible frame sees",
        needs=(_MAPPING, need(above("mapping.covisible", 0))),
        ge=0,
        le=1,
    )
    embedding_rate: float = option("learning rate of the voxel embeddings", needs=(_MAPPING, _GEOMETRY), ge=0)
    plane_rate: float = option("learning rate of the tri-planes", needs=(_MAPPING, _COLOR), ge=0)
    decoder_rate: float = option("learning rate of the geometry decoder", needs=(_MAPPING, _GEOMETRY), ge=0)
    color_decoder_rate: float = option("learning rate of the color decoder", needs=(_MAPPING, _COLOR), ge=0)
    pose_rate: float = option("learning rate of the poses", needs=(_MAPPING, _POSES), ge=0)
    optimize_poses: bool = option("optimize the poses of the selected frames together with the map", needs=(_MAPPING,))
    optimize_geometry: bool = option(
        "optimize voxel embeddings and geometry decoder; false leaves geometry to the prior's fusion", needs=(_MAPPING,)
    )
    reset_moments: bool = option("reset Adam's moments each time mapping runs", needs=(_MAPPING,))
    keep_color_moments: bool = option(
        "keep those of the tri-planes and the color decoder: colors then need fewer iterations, while kept moments of "
        "geometry would follow the noise of depth",
        needs=(_MAPPING, _COLOR, need(is_("mapping.reset_moments", True))),
    )

    def check(self) -> None:
        if self.recent + self.covisible > self.frames:
            raise ValueError(
                f"mapping.frames must be at least mapping.recent + mapping.covisible "
                f"({self.recent + self.covisible}), got {self.frames}"
            )


class PixelOptions(Section):
    """The pixel database that mapping draws from."""

    per_frame: int = option("M_k, pixels kept per frame", "px", ge=16)
    keyframe_every: int = option(
        "keep only every n-th frame and the newest one; 1 keeps all, as in the paper", "frames", ge=1
    )
    budget_mb: float = option(
        "memory for these pixels and the frames' depth thumbnails; beyond it all pixels are thinned evenly", "MB", gt=0
    )
