"""What the fused step says of arguments that do not fit."""

from dataclasses import replace

import pytest
import torch

from spslam import ops
from tests.ops.scenes import OPTIONS, make_scene
from tests.ops.step_inputs import gradient_buffers, noisy_rays


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(pixels=torch.zeros(9, 3)), TypeError, "render_step: pixels must be int32, got float32"),
        (
            dict(pixels=torch.zeros(8, 3).int()),
            ValueError,
            r"render_step: pixels must have shape \[9, 3\], got \[8, 3\]",
        ),
        (dict(ray_frames=torch.zeros(9)), TypeError, "render_step: ray_frames must be int32, got float32"),
        (dict(poses=torch.zeros(1, 6)), ValueError, r"render_step: poses must have shape \[F, 7\], got \[1, 6\]"),
        (dict(intrinsics=(1, 2)), ValueError, r"render_step: intrinsics must be \(fx, fy, cx, cy\), got \(1, 2\)"),
        (dict(num_uniform=-1), ValueError, "render_step: num_uniform must be at least 0, got -1"),
        (dict(num_surface=-1), ValueError, "render_step: num_surface must be at least 0, got -1"),
        (dict(num_uniform=0, num_surface=0), ValueError, r"num_uniform \+ num_surface must be in \[1, 65536\], got 0"),
        (dict(near=0.5, far=0.4), ValueError, r"near and far must be 0 <= near <= far, got \(0.5, 0.4\)"),
        (dict(frame=2**32), ValueError, r"render_step: frame must be in \[0, 2\^32 - 1\], got 4294967296"),
        (dict(iteration=-1), ValueError, r"render_step: iteration must be in \[0, 2\^32 - 1\], got -1"),
        (dict(truncation=0.0), ValueError, "render_step: truncation must be positive, got 0.0"),
        (dict(embeddings=torch.zeros(3, 8)), ValueError, "gradients.embeddings must have at least .* rows, got 3"),
        (dict(texel_stamps=torch.zeros(9)), TypeError, "gradients.texel_stamps must be int32, got float32"),
        (dict(texels=torch.zeros(32, 20000).T), ValueError, "gradients.texels must be contiguous, got strides"),
    ],
    ids=str,
)
def test_errors(generator, change, error, message):
    scene = make_scene(generator, random_decoder=True)
    rays = noisy_rays(generator, counts=(9,))

    def changed(argument):
        fields = {name: value for name, value in change.items() if hasattr(argument, name)}
        return replace(argument, **fields)

    with pytest.raises(error, match=message):
        ops.render_step(scene, changed(rays), changed(OPTIONS), changed(gradient_buffers(scene)))
