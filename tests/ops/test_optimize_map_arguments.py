"""What a mapping call says of arguments that do not fit."""

from dataclasses import replace

import pytest
import torch

from tests.ops.mapping_scene import RENDER_OPTIONS, Map


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(records=torch.zeros(5, 9, 3)), TypeError, "records must be int32, got float32"),
        (dict(records=torch.zeros(5, 0, 3).int()), ValueError, r"records must hold at least one pixel per frame"),
        (dict(poses=torch.zeros(4, 7)), ValueError, r"poses must have shape \[5, 7\], got \[4, 7\]"),
        (dict(poses=torch.zeros(7, 5).T), ValueError, r"poses must be contiguous, got strides \(1, 5\)"),
        (dict(frames=torch.zeros(0).long()), ValueError, "frames must name at least one frame, got 0"),
        (dict(frames=torch.tensor([0, 1]).int()), TypeError, "frames must be int64, got int32"),
        (dict(num_pixels=0), ValueError, "num_pixels must be at least 1, got 0"),
        (dict(iterations=0), ValueError, "iterations must be at least 1, got 0"),
        (dict(first_step=0), ValueError, "first_step must be at least 1, got 0"),
        (dict(first_color_step=0), ValueError, "first_color_step must be at least 1, got 0"),
        (dict(first_stamp=2**31 - 1), ValueError, "first_stamp must fit 32 bits, got 2147483647"),
        (dict(truncation=0.0), ValueError, "truncation must be positive, got 0.0"),
        (dict(precision="fp8"), ValueError, "precision must be tf32 or fp32, got fp8"),
    ],
    ids=str,
)
def test_errors(change, error, message):
    m, options = Map(torch.device("cpu")), RENDER_OPTIONS
    fields = {name: value for name, value in change.items() if hasattr(RENDER_OPTIONS, name)}
    options = replace(RENDER_OPTIONS, **fields)
    for name in ("records", "poses", "frames"):
        setattr(m, name, change.get(name, getattr(m, name)))
    numbers = {n: v for n, v in change.items() if n not in fields and not isinstance(v, torch.Tensor)}
    with pytest.raises(error, match="^optimize_map_: " + message):
        m.optimize(options, **numbers)


def test_frames_out_of_range():
    m = Map(torch.device("cpu"))
    m.frames = torch.tensor([0, 5])
    with pytest.raises(RuntimeError, match=r"optimize_map_: frames must be in \[0, 5\), got 5"):
        m.optimize(RENDER_OPTIONS)


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("exp_avg", torch.zeros(3, 8), ValueError, "embeddings.exp_avg must have at least"),
        ("exp_avg_sq", torch.zeros(200000, 7), ValueError, "embeddings.exp_avg_sq must have shape"),
        ("gradients", torch.zeros(200000, 8).long(), TypeError, "embeddings.gradients must be float32, got int64"),
        ("stamps", torch.zeros(200000), TypeError, "embeddings.stamps must be int32, got float32"),
        ("rate", -1.0, ValueError, r"embeddings.rate must be at least 0, got -1\.0"),
    ],
    ids=str,
)
def test_moments_that_do_not_fit(field, value, error, message):
    m = Map(torch.device("cpu"))
    moments = m.map_moments()
    m.map_moments = lambda frozen: replace(moments, embeddings=replace(moments.embeddings, **{field: value}))
    with pytest.raises(error, match="^optimize_map_: " + message):
        m.optimize(RENDER_OPTIONS)
