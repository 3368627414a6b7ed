"""A sensor's noise measured from residuals, and the photometric residuals that it weighs."""

import numpy as np
import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck
from tests.ops.tracking_scene import ONE_STEP, camera_points, drawn_pixels, moved_points, noise_model, pose7

CAMERA = ops.Intrinsics(60.0, 60.0, 39.5, 29.5)
SHAPE = (60, 80)
UNIT = 1e-4
STILL = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])


def _keyframe(depth, intensities=None, device="cpu"):
    """A keyframe at the world's origin; depth float [H, W] m, intensities uint8 [H, W]."""
    image = (depth / UNIT).round().to(torch.int32).to(torch.uint16)[None].to(device)
    colors = None if intensities is None else intensities[None].to(device)
    return ops.DepthKeyframes(image, UNIT, STILL[None].to(device), ((0, 0),), CAMERA, 0.03, intensities=colors)


def _records(u, v, depth, intensity):
    """Gray pixels."""
    gray = intensity.to(torch.int32)
    color = gray | gray << 8 | gray << 16
    return torch.stack([u.int() | v.int() << 16, depth.float().view(torch.int32), color], 1)


def _places(generator, n):
    return (torch.randint(1, size - 1, (n,), generator=generator) for size in reversed(SHAPE))


def _planes(z, generator):
    """Depth float64 [H, W] of planes before the camera, one per block of columns."""
    blocks = torch.arange(SHAPE[1]) * len(z) // SHAPE[1]
    return torch.tensor(z, dtype=torch.float64)[blocks].expand(SHAPE)


def _edges(first, per_octave, count):
    octave, part = np.divmod(np.arange(count + 1), per_octave)
    return first * 2.0**octave * (1 + part / per_octave)


def _model(counts, before):
    """The model of counts, in float64: medians of the bins, and least squares in which the growth keeps a share."""
    found = []
    for histogram, (first_bin, first_level, least) in enumerate(((0.25, 2.0**-18, 1e-10), (2.0**-9, 2.0**-15, 2.6e-6))):
        bins, levels, rows, roots = _edges(first_bin, 4, 32), _edges(first_level, 8, 128), [], []
        for b in np.flatnonzero(counts[histogram].sum(1) >= 50 * 256):
            own = counts[histogram, b]
            level = np.flatnonzero(2 * own.cumsum() >= own.sum())[0]
            within = (own.sum() / 2 - own[:level].sum()) / own[level]
            median = levels[level] + within * (levels[level + 1] - levels[level])
            variance, residuals = (1.4826 * median) ** 2 + least, own.sum() / 256
            roots.append(np.sqrt(residuals / (residuals + 200)))
            by = (bins[b] + bins[b + 1]) / 2
            rows.append([roots[-1] / variance, roots[-1] * by ** (4 if histogram == 0 else 2) / variance])
        rows, roots = np.array(rows), np.array(roots)
        growth = np.linalg.lstsq(rows, roots, rcond=None)[0][1]
        left = 1 - (rows[:, 0] @ rows[:, 1]) ** 2 / ((rows**2).sum(0).prod())
        growth = (0.01 * before[2 * histogram + 1] + left * max(growth, 0)) / (left + 0.01)
        floor = rows[:, 0] @ (roots - growth * rows[:, 1]) / (rows[:, 0] @ rows[:, 0])
        found += [floor, growth] if floor >= 0 else [0, np.linalg.lstsq(rows[:, 1:], roots, rcond=None)[0][0]]
    return found


def test_the_model_is_the_least_squares_fit_of_the_medians(device, generator):
    noise, before = ops.SensorNoise.unknown(device), ops.SensorNoise.unknown().model.tolist()
    depth = _planes([0.6, 1.1, 2.0, 3.5], generator)
    intensities = torch.randint(0, 256, SHAPE, generator=generator, dtype=torch.uint8)
    u, v = _places(generator, 4000)
    noisy = depth[v, u] + 0.004 * depth[v, u] ** 2 * torch.randn(4000, generator=generator, dtype=torch.float64)
    pixels = _records(u, v, noisy, torch.randint(0, 256, (4000,), generator=generator)).to(device)
    ops.measure_noise_(noise, pixels, STILL.to(device), CAMERA, _keyframe(depth, intensities, device))
    faded = noise.counts.cpu().double().numpy()
    assert (faded % 240 == 0).all()  # 256 for each residual, less a sixteenth
    torch.testing.assert_close(
        noise.model.cpu().double(), torch.tensor(_model(faded / 240 * 256, before)), rtol=1e-3, atol=1e-10
    )


@pytest.mark.parametrize(("floor_m", "growth"), [(0.001, 0.002), (0.003, 0.0), (0.0005, 0.004)])
def test_noise_of_depth_is_found(device, generator, floor_m, growth):
    noise, depth = ops.SensorNoise.unknown(device), _planes([0.5, 0.8, 1.2, 1.8, 2.5, 3.5], generator)
    for _ in range(20):
        u, v = _places(generator, 3000)
        z = depth[v, u]
        deviation = (floor_m**2 + growth**2 * z**4).sqrt()
        pixels = _records(u, v, z + deviation * torch.randn(3000, generator=generator, dtype=torch.float64), u * 0)
        ops.measure_noise_(noise, pixels.to(device), STILL.to(device), CAMERA, _keyframe(depth, device=device))
    found = noise.model.cpu()
    for z in (0.5, 1.8, 3.5):
        want = (floor_m**2 + growth**2 * z**4) ** 0.5
        assert float(found[0] + found[1] * z**4) ** 0.5 == pytest.approx(want, rel=0.12)
    assert found[2:].tolist() == [1.0, 0.25]  # no intensities were given


@pytest.mark.parametrize("shift_px", [0.2, 1.0])
def test_registration_error_of_intensities_is_found(device, generator, shift_px):
    """Intensities that are read some pixels aside, of an image of smooth slopes of all sizes."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    value = 128 + 100 * np.sin(columns / 6.0 + rows / 15.0) * np.cos(rows / 8.0)
    noise, depth = ops.SensorNoise.unknown(device), torch.full(SHAPE, 1.5, dtype=torch.float64)
    for _ in range(20):
        u, v = _places(generator, 3000)
        aside = shift_px * torch.randn(2, 3000, generator=generator, dtype=torch.float64).numpy()
        x, y = u.numpy() + aside[0], v.numpy() + aside[1]
        gray = torch.from_numpy(128 + 100 * np.sin(x / 6.0 + y / 15.0) * np.cos(y / 8.0)).round()
        keyframe = _keyframe(depth, torch.from_numpy(value).round().to(torch.uint8), device)
        pixels = _records(u, v, depth[v, u], gray).to(device)
        ops.measure_noise_(noise, pixels, STILL.to(device), CAMERA, keyframe)
    assert float(noise.model[3]) ** 0.5 == pytest.approx(shift_px, rel=0.15)
    assert float(noise.model[2]) ** 0.5 < 0.01


def test_old_residuals_fade(device, generator):
    # In the middle of a bin.
    noise, depth = ops.SensorNoise.unknown(device), torch.full(SHAPE, 2.25, dtype=torch.float64)
    keyframe = _keyframe(depth, device=device)
    u, v = _places(generator, 500)
    for error, frames in ((0.02, 5), (0.001, 60)):
        for _ in range(frames):
            pixels = _records(u, v, depth[v, u] + error, u * 0).to(device)
            ops.measure_noise_(noise, pixels, STILL.to(device), CAMERA, keyframe)
    assert float(noise.model[0] + 2.25**4 * noise.model[1]) ** 0.5 == pytest.approx(1.4826e-3, rel=0.1)


def test_nothing_to_compare_leaves_the_model(device):
    noise, depth = ops.SensorNoise.unknown(device), torch.full(SHAPE, 2.0, dtype=torch.float64)
    ops.measure_noise_(
        noise,
        torch.zeros(0, 3, dtype=torch.int32, device=device),
        STILL.to(device),
        CAMERA,
        _keyframe(depth, None, device),
    )
    assert not noise.counts.any()
    assert torch.equal(noise.model.cpu(), ops.SensorNoise.unknown().model)


@pytest.mark.parametrize("bad", [0.0, -1.0, torch.nan, torch.inf])
def test_pixels_without_depth_add_nothing(device, generator, bad):
    noise, depth = ops.SensorNoise.unknown(device), torch.full(SHAPE, 2.0, dtype=torch.float64)
    u, v = _places(generator, 50)
    keyframe = _keyframe(depth, torch.zeros(SHAPE, dtype=torch.uint8), device)
    pixels = _records(u, v, torch.full((50,), bad), u * 0).to(device)
    ops.measure_noise_(noise, pixels, STILL.to(device), CAMERA, keyframe)
    pixels = _records(u, v, depth[v, u], u * 0).to(device)
    ops.measure_noise_(noise, pixels, torch.full_like(STILL, bad, device=device) / 0, CAMERA, keyframe)
    assert not noise.counts.any()


def test_photometric_residuals_are_those_of_autograd(device, generator):
    """A wall that geometry leaves free to slide along: the step is that of depth and intensities together."""
    depth = torch.full(SHAPE, 1.5, dtype=torch.float64)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    value = torch.from_numpy(128 + 60 * np.sin(columns / 5.0) + 50 * np.cos(rows / 4.0)).round().to(torch.uint8)
    u, v = _places(generator, 300)
    gray = (value[v, u] + torch.randint(0, 12, (300,), generator=generator)).clamp(max=255)
    records = _records(u, v, depth[v, u] + 0.002 * torch.rand(300, generator=generator, dtype=torch.float64), gray)
    s2, e2, a2 = 1e-4, 0.16, 4e-6
    noise = noise_model(a2, 0.0, s2, e2, device=device)
    # So that no projection lies on the border of two pixels.
    start = np.eye(4)
    start[:3, 3] = [0.004, -0.003, 0.001]
    drawn = drawn_pixels(records)
    pose, *_ = ops.track_gauss_newton(
        ops.SceneView.empty(device=device), records.to(device), pose7(start, device), CAMERA, ONE_STEP, noise=noise,
        depth_keyframes=_keyframe(depth, value, device),
    )  # fmt: skip
    local, zero = camera_points(drawn, CAMERA), torch.zeros(6, dtype=torch.float64)
    image = value.double() / 255

    def intensity(increment):
        x, y, z = moved_points(local, increment, start).unbind(-1)
        size = torch.tensor([SHAPE[1] - 1, SHAPE[0] - 1], dtype=torch.float64)
        uv = torch.stack([x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy], -1)
        return torch.nn.functional.grid_sample(image[None, None], (2 * uv / size - 1)[None, None], align_corners=True)[
            0, 0, 0
        ]

    def pixels_of(increment):
        x, y, z = moved_points(local, increment, start).unbind(-1)
        return torch.stack([x / z * CAMERA.fx, y / z * CAMERA.fy], -1)

    own = ((drawn[:, 2] & 0xFF).double()) / 255
    difference, slope = intensity(zero) - own, torch.autograd.functional.jacobian(intensity, zero)
    # The slope in the image: least squares over the increments, as pixels move by them.
    moves = torch.func.jacfwd(pixels_of)(zero)
    gradient2 = torch.stack(
        [torch.linalg.lstsq(m.T, g[:, None]).solution.square().sum() for m, g in zip(moves, slope, strict=True)]
    )
    deviation = (s2 + e2 * gradient2).sqrt()
    meters = 2 * (1e-8 + a2) ** 0.5 * min(1, 0.3 / e2**0.5) / deviation
    robust = (1 / (1 + (difference / (3 * deviation)) ** 2)) ** 2
    hessian = torch.einsum("n,ni,nj->ij", robust * meters**2, slope, slope)
    downhill = torch.einsum("n,ni,n->i", robust * meters**2, slope, difference)
    # The wall: distances along z alone.
    z_move = torch.func.jacfwd(lambda i: moved_points(local, i, start)[:, 2])(zero)
    distance = moved_points(local, zero, start)[:, 2] - 1.5
    weight = (1 / (1 + (distance / 0.03) ** 2)) ** 2
    hessian = hessian + torch.einsum("n,ni,nj->ij", weight, z_move, z_move)
    downhill = downhill + torch.einsum("n,ni,n->i", weight, z_move, distance)
    delta = -torch.linalg.solve(hessian + (1e-6 * hessian.trace() + 1e-8) * torch.eye(6, dtype=torch.float64), downhill)
    assert delta[:2].norm() > 1e-3
    torch.testing.assert_close(pose[4:].cpu().double() - torch.tensor(start[:3, 3]), delta[:3], rtol=0.02, atol=2e-5)


def test_a_plain_image_of_a_sensor_without_noise_holds_nothing(device, generator):
    """A measured floor of 0 and pixels without gradient: they would weigh infinitely, and nothing would move."""
    depth = torch.full(SHAPE, 1.5, dtype=torch.float64)
    u, v = _places(generator, 300)
    records = _records(u, v, depth[v, u], torch.full((300,), 90)).to(device)
    keyframe = _keyframe(depth, torch.full(SHAPE, 90, dtype=torch.uint8), device)
    start = np.eye(4)
    start[2, 3] = 0.02
    poses = [
        ops.track_gauss_newton(
            ops.SceneView.empty(device=device), records, pose7(start, device), CAMERA, ONE_STEP,
            noise=noise_model(4e-6, 0.0, 0.0, 1.0, device=device), depth_keyframes=each,
        )[0]
        for each in (keyframe, keyframe._replace(intensities=None))
    ]  # fmt: skip
    torch.testing.assert_close(poses[0], poses[1], rtol=0, atol=1e-6)
    assert abs(float(poses[0][6])) < 0.005


def test_devices_agree_on_counts(device, generator):
    depth, u, v = _planes([0.6, 1.1, 2.0], generator), *_places(generator, 1000)
    intensities = torch.randint(0, 256, SHAPE, generator=generator, dtype=torch.uint8)
    pixels = _records(u, v, depth[v, u] + 0.01 * torch.rand(1000, generator=generator, dtype=torch.float64), u)
    found = []
    for place in ("cpu", device):
        noise = ops.SensorNoise.unknown(place)
        ops.measure_noise_(noise, pixels.to(place), STILL.to(place), CAMERA, _keyframe(depth, intensities, place))
        found.append(noise)
    # Rounding may move a residual to the next level.
    assert (found[0].counts - found[1].counts.cpu()).abs().sum() <= 0.02 * found[0].counts.sum()
    torch.testing.assert_close(found[1].model.cpu(), found[0].model, rtol=0.02, atol=1e-8)


def test_opcheck(device):
    noise, keyframe = (
        ops.SensorNoise.unknown(),
        _keyframe(torch.full(SHAPE, 2.0), torch.zeros(SHAPE, dtype=torch.uint8)),
    )
    pixels = torch.zeros(5, 3, dtype=torch.int32)
    call = (noise.counts, noise.model, pixels, STILL, list(CAMERA), *keyframe.arguments())
    opcheck(torch.ops.spslam.measure_noise_.default, call, device)


def test_wrong_arguments_are_errors():
    noise, keyframe = ops.SensorNoise.unknown(), _keyframe(torch.full(SHAPE, 2.0))
    pixels = torch.zeros(5, 3, dtype=torch.int32)
    for changed, message in (
        ((noise._replace(counts=noise.counts[:1]), pixels, STILL, CAMERA, keyframe), "noise.counts"),
        ((noise, pixels[:, :2], STILL, CAMERA, keyframe), "pixels"),
        ((noise, pixels, STILL[:6], CAMERA, keyframe), "pose"),
        (
            (noise, pixels, STILL, CAMERA, keyframe._replace(intensities=torch.zeros(1, 2, 2, dtype=torch.uint8))),
            "inten",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            ops.measure_noise_(*changed)
