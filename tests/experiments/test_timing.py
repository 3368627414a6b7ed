"""What the timing scripts write, and that their room is consistent."""

import json
import time

import pytest
import torch

from experiments import room, timing
from experiments.composable_ops import grid_sample
from spslam import ops


def test_report_holds_rows_and_environment(tmp_path, capsys):
    times = timing.compare({"sum": lambda: torch.ones(10).sum()}, rounds=3, device=torch.device("cpu"))
    timing.report("title", [{"op": "sum", "ms": times["sum"]}], torch.device("cpu"), tmp_path / "out.json")
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["rows"] == [{"op": "sum", "ms": times["sum"]}]
    assert written["environment"]["torch"] == torch.__version__
    assert capsys.readouterr().out.startswith("title\nop")


@pytest.mark.cuda
def test_gpu_time_excludes_launch_overhead():
    def slow_to_launch():
        time.sleep(2e-3)
        return torch.ones(10, device="cuda").sum()

    device = torch.device("cuda")
    wall = timing.compare({"sum": slow_to_launch}, rounds=3, device=device)["sum"]
    assert 0 < timing.compare_on_gpu({"sum": slow_to_launch}, rounds=3, device=device)["sum"] < 0.5 < wall


def test_rays_end_at_the_walls(generator):
    rays = room.make_rays(generator, 500, 20, torch.device("cpu"))
    assert rays.ray_frames.unique().numel() == 20 and (rays.ray_frames.diff() >= 0).all()
    from experiments.compose import unpack_pixels, world_points

    seen = unpack_pixels(rays.pixels, rays.intrinsics, torch.float32)
    ends = world_points(rays, seen.directions, seen.depth[:, None], None)[:, 0]
    # Depth carries 5 mm of noise, and rays are up to 1.25 times as long.
    assert room.wall_distance(ends).abs().max() < 0.04
    assert (seen.cosine > 0).all()


def test_grid_sample_gives_the_same(generator):
    image, uv = torch.randn(7, 9, 3, generator=generator), torch.rand(50, 2, generator=generator) * 6
    torch.testing.assert_close(grid_sample(image, uv), ops.bilinear_interpolate(image, uv), rtol=1e-4, atol=1e-4)
