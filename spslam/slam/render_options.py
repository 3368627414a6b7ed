"""What tracking and mapping share: the settings of a render step."""

from spslam import ops
from spslam.config import Config


def render_options(config: Config, stream: ops.RandomStream, frame: int, iteration: int = 0) -> ops.RenderOptions:
    """Sampling, losses and random stream (Philox) of the render steps of a call, from an iteration on."""
    return ops.RenderOptions(
        num_uniform=config.sampling.uniform,
        num_surface=config.sampling.surface,
        near=config.sampling.near,
        far=config.sampling.far,
        truncation=config.scene.truncation,
        cosine_targets=config.loss.cosine_targets,
        weight_rgb=config.loss.rgb,
        weight_depth=config.loss.depth,
        weight_free_space=config.loss.free_space,
        weight_sdf=config.loss.sdf,
        seed=config.seed,
        stream=stream,
        frame=frame,
        iteration=iteration,
        precision=config.precision,
    )
