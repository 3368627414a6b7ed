"""Valid calls of the ops that take a whole scene, or frames; see `cases`."""

import torch

from spslam import ops
from tests.ops.case_inputs import KEY, normal, on_device, uniform
from tests.ops.scenes import INTRINSICS, TRUNCATION, make_scene

POSE = torch.tensor([1.0, 0, 0, 0, 0.02, -0.1, 0.05])


def scene_points(generator, device, n):
    scene = make_scene(generator, random_decoder=True, device=device)
    return dict(scene=scene, points=(uniform(generator, n, 3) * 1.2).to(device))


def pixel_records(generator, *shape):
    """Packed pixels of a 64 x 48 camera, 0.5 to 1.5 m away."""
    u = torch.randint(0, 64, shape, generator=generator, dtype=torch.int32)
    v = torch.randint(0, 48, shape, generator=generator, dtype=torch.int32)
    depth = (0.5 + uniform(generator, *shape)).view(torch.int32)
    return torch.stack([u | v << 16, depth, torch.full_like(u, 0x40402010)], -1)


def render_step(generator, device, n):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = ops.RayBatch(
        pixels=pixel_records(generator, n).to(device),
        ray_frames=(torch.arange(n, dtype=torch.int32) * 2 // max(n, 1)).to(device),
        poses=torch.stack([POSE, POSE]).to(device),
        intrinsics=INTRINSICS,
    )
    weights = dict(weight_rgb=5.0, weight_depth=0.1, weight_free_space=10.0, weight_sdf=200.0)
    options = ops.RenderOptions(16, 5, near=0.2, far=1.02, truncation=TRUNCATION, cosine_targets=True, **weights, **KEY)
    gradients = ops.SceneGradients(
        torch.zeros_like(scene.embeddings),
        torch.zeros(len(scene.embeddings), dtype=torch.int32, device=device),
        torch.zeros_like(scene.texels),
        torch.zeros(len(scene.texels), dtype=torch.int32, device=device),
        stamp=1,
    )
    return dict(scene=scene, rays=rays, options=options, gradients=gradients)


def track(generator, device, n):
    scene = make_scene(generator, random_decoder=True, device=device)
    widths = dict(kernel_start=0.08, kernel_end=0.02, damping=1e-4)
    key = {name: value for name, value in KEY.items() if name != "iteration"}
    options = ops.GaussNewtonOptions(num_pixels=32, iterations=2, truncation=TRUNCATION, **widths, **key)
    cells = torch.stack([uniform(generator, 6, 8), 1 + 0.05 * uniform(generator, 6, 8)], -1).to(device)
    reference = ops.ReferenceImage(cells, POSE.to(device), ops.Intrinsics(7.5, 7.5, 3.5, 2.5), weight=0.05, kernel=0.1)
    return dict(
        scene=scene,
        reference=reference,
        pixels=pixel_records(generator, max(n, 1)).to(device),
        pose=POSE.to(device),
        intrinsics=INTRINSICS,
        options=options,
        noise=torch.tensor([1e-6, 1e-5, 1e-4, 0.1], device=device),
    )


def _image_pairs(generator, device, n):
    depth = (10000 + 500 * uniform(generator, 3, 12, 16)).to(torch.int32).to(torch.uint16)
    pixels, normals = pixel_records(generator, 2, 40), torch.nn.functional.normalize(normal(generator, 2, 40, 3), dim=2)
    camera = ops.Intrinsics(15.0, 15.0, 7.5, 5.5)
    numbers = torch.tensor([3, 5], device=device)
    pairs = torch.stack([torch.arange(n) % 2, torch.arange(n) % 3], 1)
    intensities = (255 * uniform(generator, 3, 12, 16)).to(torch.uint8).to(device)
    return dict(
        sources=ops.DrawnPixels(pixels.to(device), normals.to(device), numbers, INTRINSICS),
        targets=ops.DepthImages(depth.to(device), 1e-4, camera, intensities),
        pairs=pairs.to(device),
        poses=POSE.expand(n, 7).contiguous().to(device),
        noise=torch.tensor([1e-6, 1e-5, 1e-4, 0.1], device=device),
    )


def align_images(generator, device, n):
    key = {name: KEY[name] for name in ("seed", "stream")}
    options = ops.AlignmentOptions(num_pixels=16, iterations=2, kernel_start=0.08, kernel_end=0.02, damping=1e-4, **key)
    return _image_pairs(generator, device, n) | dict(options=options)


def compare_images(generator, device, n):
    return _image_pairs(generator, device, n) | dict(tolerance=0.05)


def measure_noise(generator, device, n):
    images = (2000 + 100 * uniform(generator, 2, 12, 16)).to(torch.int32)
    intensities = (255 * uniform(generator, 2, 12, 16)).to(torch.uint8).to(device)
    keyframes = ops.DepthKeyframes(
        images.to(torch.uint16).to(device),
        1e-3,
        POSE[None].to(device),
        ((0, 0), (1, 0)),
        INTRINSICS,
        0.01,
        0,
        intensities,
    )
    return dict(
        noise=ops.SensorNoise.unknown(device),
        pixels=pixel_records(generator, n).to(device),
        pose=POSE.to(device),
        intrinsics=INTRINSICS,
        depth_keyframes=keyframes,
    )


def measure_timing(generator, device, n):
    call = measure_noise(generator, device, n)
    timing, motion = ops.CaptureTiming.unknown(device), ops.FrameMotion(0, 0.03)
    colors = ops.ColorTiming(timing.color_delay, (motion, motion), motion)
    noise = call.pop("noise").model
    return call | dict(timing=timing, noise=noise, depth_keyframes=call["depth_keyframes"]._replace(timing=colors))


def _shutter(device):
    before = POSE.clone()
    before[4:] += 0.01
    return ops.ShutterMotion(before.to(device), POSE.to(device), 0.03, torch.tensor([0.02], device=device))


def rectify_records(generator, device, n):
    records = pixel_records(generator, n).to(device)
    size = dict(height=48, width=64)
    return dict(out=records.clone(), records=records, motion=_shutter(device), intrinsics=INTRINSICS, **size)


def rectify_images(generator, device, n):
    depth = (2000 + 100 * uniform(generator, 12, 16)).to(torch.int32).to(torch.uint16).to(device)
    intensity = (255 * uniform(generator, 12, 16)).to(torch.uint8).to(device)
    outputs = dict(out_depth=depth.clone(), out_intensity=intensity.clone())
    return outputs | dict(depth=depth, intensity=intensity, motion=_shutter(device), intrinsics=INTRINSICS, unit=1e-3)


def frame_equations(generator, device, n):
    scene = make_scene(generator, random_decoder=True, device=device)
    poses = torch.stack([POSE, POSE]).to(device)
    frames = dict(pixels=pixel_records(generator, 2, n).to(device), poses=poses, intrinsics=INTRINSICS)
    return dict(scene=scene, **frames, truncation=TRUNCATION, kernel=0.05)


def track_adam(generator, device, n):
    call = track(generator, device, n)
    options = render_step(generator, device, 1)["options"]
    steps = dict(num_pixels=32, iterations=2, rotation_rate=1e-3, translation_rate=1e-3)
    return dict(
        scene=call["scene"],
        records=call["pixels"],
        pose=call["pose"],
        intrinsics=INTRINSICS,
        options=options,
        **steps,
    )


def optimize_map(generator, device, n):
    call = frame_equations(generator, device, max(n, 1))
    params = call["scene"].geometry_params
    decoder = ops.AdamMoments(torch.zeros_like(params), torch.zeros_like(params), rate=1e-3)
    steps = dict(num_pixels=32, iterations=2, fixed_frame=0, first_step=1, first_stamp=1)
    return dict(
        scene=call["scene"],
        records=call["pixels"],
        poses=call["poses"],
        frames=torch.tensor([0, 1]),
        intrinsics=INTRINSICS,
        options=render_step(generator, device, 1)["options"],
        moments=ops.MapMoments(geometry_params=decoder),
        **steps,
    )


def predict(generator, device, n):
    return dict(before=POSE.to(device), last=(POSE + torch.tensor([0, 0, 0, 0, 0.1, 0, 0])).to(device))


def copy_rows(generator, device, n):
    tables = [uniform(generator, n + 1, 7), torch.zeros(4, 3, dtype=torch.int32)]
    values = [uniform(generator, 7), torch.ones(3, dtype=torch.int32)]
    return dict(
        tables=[table.to(device) for table in tables], rows=[n, 2], values=[value.to(device) for value in values]
    )


def icp(generator, device, n):
    vertices = uniform(generator, 6, 8, 3) + torch.tensor([-0.5, -0.5, 1.0])
    normals = torch.nn.functional.normalize(normal(generator, 6, 8, 3), dim=-1)
    points = uniform(generator, n, 3) + torch.tensor([-0.5, -0.5, 1.0])
    tensors = dict(points=points, vertices=vertices, normals=normals, pose=POSE)
    return on_device(device, tensors) | dict(intrinsics=ops.Intrinsics(8.0, 8.0, 3.5, 2.5), iterations=3)


def views(generator, device, n):
    depth_thumbnails = (1 + uniform(generator, n, 3, 4)).half()
    return on_device(device, dict(poses=POSE.repeat(n, 1), depth_thumbnails=depth_thumbnails)) | dict(
        intrinsics=INTRINSICS, thumbnail_step=16
    )


def overlap(generator, device, n):
    return dict(points=normal(generator, n, 3).to(device)) | views(generator, device, n)


def select(generator, device, n):
    counts = dict(num_points=20, num_covisible=5, count=9, threshold=0.1, seed=7, frame=3)
    tensors = on_device(device, dict(records=pixel_records(generator, max(n, 1)), candidates=torch.arange(n)))
    return tensors | dict(current=0) | views(generator, device, max(n, 1)) | counts
