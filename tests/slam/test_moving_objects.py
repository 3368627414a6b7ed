"""What moves before a camera: cells by the definition and by the op, what is left out of a frame, whole runs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.config import load_config
from spslam.datasets.places import Capture, PlacesDataset
from spslam.geometry import inverse, pose7_to_matrix
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.depth_history import FADES, MOST_OFF, DepthHistory
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_image_step, depth_unit
from spslam.slam.device_events import HostEvent
from spslam.slam.image_features import ImageFeatures
from spslam.slam.moving_objects import DEVIATIONS, FEWEST_PIXELS, MARGIN_M, NOTICED, MovingObjects, StaticFrame
from spslam.slam.pixels import THUMBNAIL_STEP_PX, sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.system import SlamSystem
from tests.ops.arguments import opcheck
from tests.system.sequences import settings

CPU = torch.device("cpu")
FRAMES, STEP = (0, 10, 20, 30, 40, 45), 3
UNIT, TURN = depth_unit(8.0), 0.001
NOISE = torch.tensor([9e-6, 1.69e-6, 1.0, 0.25])
OPS = (torch.ops.spslam.find_moving_cells, torch.ops.spslam.leave_out_moving)


@pytest.fixture(scope="module")
def walked():
    capture = Capture(width=160, height=120)
    return PlacesDataset("room", "walking", "structured_light", 60, 6, capture=capture, people=2)


@pytest.fixture(scope="module")
def frames(walked):
    """Depth images uint16 of `FRAMES`, and their poses."""
    depth = [torch.from_numpy((walked[i].depth / UNIT + 0.5).astype(np.uint16)) for i in FRAMES]
    return torch.stack(depth), torch.stack([pose_tensor(walked.poses()[i], CPU) for i in FRAMES])


def found(walked, frames, device, newest=-1, rows=None, noise=NOISE, step=STEP):
    images, poses = (each.to(device) for each in frames)
    cells = images[:, ::step, ::step].contiguous()
    last = len(FRAMES) + newest
    rows = [(i, i) for i in range(last)] if rows is None else rows
    grid = ops.comparison.DepthCells(depth_image_intrinsics(walked.camera), UNIT, step, MARGIN_M, TURN, DEVIATIONS)
    return ops.comparison.find_moving_cells(images[last], poses[last], (cells, poses, rows), noise.to(device), grid)


def around(values, row, column):
    return values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]


def nearest(depth, row, column):
    known = around(depth, row, column)
    return known[known > 0].min() if (known > 0).any() else 0.0


def expected(walked, frames, step):
    """The cells of the newest frame by the definition, one after the other."""
    images, poses = frames[0].numpy().astype(float) * UNIT, pose7_to_matrix(frames[1].double().numpy())
    cells, k = images[:, ::step, ::step], depth_image_intrinsics(walked.camera)
    now, shape = cells[-1], cells[-1].shape
    floor, growth = NOISE[:2].double().numpy()

    def margin(z):
        return MARGIN_M + TURN * z + DEVIATIONS * np.sqrt(floor + growth * z**4)

    def seen(source, target, row, column, z):
        u, v = column * step, row * step
        point = poses[source] @ [(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z, 1]
        x, y, depth, _ = inverse(poses[target]) @ point
        if depth <= 0.05:
            return None
        column, row = (int(np.floor(p / step + 0.5)) for p in (x / depth * k.fx + k.cx, y / depth * k.fy + k.cy))
        return (row, column, depth) if 0 <= row < shape[0] and 0 <= column < shape[1] else None

    free, same, gone = np.zeros((3, *shape), bool)
    newest = len(FRAMES) - 1
    for earlier in range(newest):
        then = cells[earlier]
        for row, column in np.ndindex(shape):
            if now[row, column] > 0 and (place := seen(newest, earlier, row, column, now[row, column])):
                r, c, z = place
                same[row, column] |= then[r, c] > 0 and abs(z - then[r, c]) < margin(z)
                free[row, column] |= nearest(then, r, c) > 0 and z < nearest(then, r, c) - margin(z)
            if then[row, column] > 0 and (place := seen(earlier, newest, row, column, then[row, column])):
                r, c, z = place
                behind = nearest(now, r, c)
                gone[r, c] |= behind > 0 and z < behind - margin(behind)
    seems = (free | (gone & ~same)) & (now > 0)
    moving = np.zeros(shape, bool)
    for row, column in np.ndindex(shape):
        moving[row, column] = seems[row, column] and around(seems, row, column).mean() > 0.5
    marked = [around(moving, row, column).any() for row, column in np.ndindex(shape)]
    return np.reshape(marked, shape), [moving.sum(), (now > 0).sum()]


@pytest.mark.parametrize("step", [STEP, 2])  # 54 and 80 columns; the CPU looks at 64 at a time
def test_cells_by_the_definition(walked, frames, device, step):
    cells, counts = found(walked, frames, device, step=step)
    marked, numbers = expected(walked, frames, step)
    assert 0.03 < numbers[0] / numbers[1] < 0.5
    assert (cells.cpu().numpy() != marked).sum() <= 9  # one cell and those around, at a border
    np.testing.assert_allclose(counts.cpu().numpy(), numbers, atol=1)


def test_cells_are_those_of_people(walked, frames, device):
    alone = PlacesDataset("room", "walking", "exact", 60, 6, capture=Capture(width=160, height=120))
    depth = frames[0][-1].numpy() * UNIT
    people = (depth > 0) & (depth < 0.9 * alone[FRAMES[-1]].depth)
    cells = found(walked, frames, device)[0].cpu().numpy() > 0
    shown = people[::STEP, ::STEP]
    assert (cells & shown).sum() > 0.6 * shown.sum()
    beside = torch.nn.functional.max_pool2d(torch.from_numpy(shown)[None].float(), 3, 1, 1)[0].numpy() > 0
    assert (cells & ~beside & (depth > 0)[::STEP, ::STEP]).sum() < 0.1 * cells.sum()


def test_nothing_moves_before_a_camera_alone(device):
    data = PlacesDataset("room", "walking", "structured_light", 60, 5, capture=Capture(width=160, height=120))
    depth = torch.stack([torch.from_numpy((data[i].depth / UNIT + 0.5).astype(np.uint16)) for i in FRAMES])
    poses = torch.stack([pose_tensor(data.poses()[i], CPU) for i in FRAMES])
    moving, known = found(data, (depth, poses), device)[1].tolist()
    assert moving < 0.01 * known


def test_no_earlier_frame_says_nothing(walked, frames, device):
    cells, counts = found(walked, frames, device, rows=[])
    assert not cells.any()
    assert counts[0] == 0


@pytest.mark.cuda
def test_cuda_finds_and_leaves_out_the_same(walked, frames):
    cuda = torch.device("cuda")
    there, here = found(walked, frames, cuda), found(walked, frames, CPU)
    assert all(torch.equal(a.cpu(), b) for a, b in zip(there, here, strict=True))
    pixels = sample_frame(walked[FRAMES[-1]], walked.camera, settings())
    for a, b in zip(left_out(walked, pixels, *there), left_out(walked, pixels, *here), strict=True):
        assert torch.equal(a.cpu().view(torch.uint8), b.view(torch.uint8))


def left_out(walked, pixels, cells, counts, shares=(0.02, 0.5)):
    samples = (pixels.records, pixels.normals, pixels.depth_image, pixels.depth_thumbnail)
    steps = ops.comparison.SampleSteps(depth_image_step(walked.camera), THUMBNAIL_STEP_PX, STEP)
    samples = tuple(each.to(cells.device) for each in samples)
    return ops.comparison.leave_out_moving(samples, cells, counts, steps, shares, FEWEST_PIXELS)


def test_what_moves_is_left_out(walked, frames, device):
    pixels = sample_frame(walked[FRAMES[-1]], walked.camera, settings())
    cells, counts = found(walked, frames, device)
    records, normals, depth, thumbnail = (each.cpu() for each in left_out(walked, pixels, cells, counts))
    marked = cells.cpu().numpy() > 0
    rows, columns = np.indices(pixels.depth_image.shape)
    is_out = marked[
        np.minimum((rows + STEP // 2) // STEP, len(marked) - 1),
        np.minimum((columns + STEP // 2) // STEP, marked.shape[1] - 1),
    ]
    np.testing.assert_array_equal(depth.numpy(), np.where(is_out, 0, pixels.depth_image.numpy()))
    middle = THUMBNAIL_STEP_PX // 2
    shown = is_out[middle::THUMBNAIL_STEP_PX, middle::THUMBNAIL_STEP_PX]
    np.testing.assert_array_equal(thumbnail.numpy(), np.where(shown, 0, pixels.depth_thumbnail.numpy()))
    u, v = (pixels.records[:, 0] & 0xFFFF).numpy(), (pixels.records[:, 0] >> 16).numpy()
    stays = np.flatnonzero(~is_out[v, u])
    places = np.arange(len(u))
    places[is_out[v, u]] = stays[np.arange(len(u) - len(stays)) % len(stays)]
    assert len(stays) < len(u)
    assert torch.equal(records, pixels.records[places])
    assert torch.equal(normals, pixels.normals[places])


@pytest.mark.parametrize("shares", [(0.9, 1.0), (0.0, 0.001)])
def test_too_little_and_too_much_is_left_as_it_was(walked, frames, device, shares):
    pixels = sample_frame(walked[FRAMES[-1]], walked.camera, settings())
    cells, counts = found(walked, frames, device)
    records, normals, depth, thumbnail = left_out(walked, pixels, cells, counts, shares)
    assert torch.equal(records.cpu(), pixels.records)
    assert torch.equal(normals.cpu(), pixels.normals)
    assert torch.equal(depth.cpu(), pixels.depth_image)
    assert torch.equal(thumbnail.cpu(), pixels.depth_thumbnail)


def test_too_few_records_are_left_as_they_were(walked, frames, device):
    pixels = sample_frame(walked[FRAMES[-1]], walked.camera, settings())
    cells, counts = found(walked, frames, device)
    assert torch.equal(left_out(walked, pixels, torch.ones_like(cells), counts)[0].cpu(), pixels.records)


def raw_calls(walked, frames, device):
    images, poses = (each.to(device) for each in frames)
    grids = images[:, ::STEP, ::STEP].contiguous()
    k = list(depth_image_intrinsics(walked.camera))
    find = [
        images[-1],
        poses[-1],
        grids,
        poses,
        NOISE.to(device),
        [*k, UNIT, MARGIN_M, TURN, DEVIATIONS],
        STEP,
        [0, 0, 1, 1],
    ]
    cells, counts = found(walked, frames, device)
    pixels = sample_frame(walked[0], walked.camera, settings()).to(device)
    leave = [pixels.records, pixels.normals, pixels.depth_image, pixels.depth_thumbnail, cells, counts]
    return find, [*leave, [0.02, 0.5], [1, THUMBNAIL_STEP_PX, STEP, FEWEST_PIXELS]]


def test_opcheck(walked, frames, device):
    for op, call in zip(OPS, raw_calls(walked, frames, device), strict=True):
        opcheck(op.default, call, device)


@pytest.mark.parametrize(
    ("op", "argument", "bad"),
    [
        (0, 0, lambda depth: depth[0]),
        (0, 0, lambda depth: depth[:100]),
        (0, 1, lambda pose: pose[:6]),
        (0, 2, lambda earlier: earlier[0]),
        (0, 2, lambda earlier: earlier[:, :0]),
        (0, 3, lambda poses: poses[:, :6].contiguous()),
        (0, 4, lambda noise: noise[:1]),
        (0, 5, lambda scalars: scalars[1:]),
        (0, 6, lambda step: 0),
        (0, 7, lambda rows: [6, 0]),
        (0, 7, lambda rows: [0, -1]),
        (0, 7, lambda rows: [0, 0] * 17),
        (1, 0, lambda records: records[:, :2]),
        (1, 1, lambda normals: normals[1:]),
        (1, 2, lambda depth: depth[0]),
        (1, 0, lambda records: records[:0]),
        (1, 3, lambda thumbnail: thumbnail.float()),
        (1, 4, lambda cells: cells[0]),
        (1, 4, lambda cells: cells[:0]),
        (1, 5, lambda counts: counts[:1]),
        (1, 6, lambda scalars: scalars[1:]),
        (1, 7, lambda integers: [1, 16, 0, 100]),
        (1, 7, lambda integers: [1, 16, 3, 0]),
    ],
)
def test_bad_arguments_are_refused(walked, frames, device, op, argument, bad):
    call = raw_calls(walked, frames, device)[op]
    call[argument] = bad(call[argument])
    with pytest.raises(RuntimeError, match="find_moving_cells: |leave_out_moving: "):
        OPS[op](*call)


def test_history_keeps_a_frame_now_and_then(walked):
    history = DepthHistory(walked.camera)
    image = torch.full((120, 160), 7, dtype=torch.uint16)
    kept = []
    for frame in range(60):
        if history.takes(frame, (frame - max(history.frames)) / 30 * (frame > 0)):
            history.keep(frame, image[:: history.step, :: history.step])
            kept.append(frame)
    assert kept == list(range(0, 60, 5))
    assert sorted(history.frames) == kept[-10:]
    assert history.known(lambda frame: frame == 20, lambda frame: (60 - frame) / 30) == [
        (slot, frame) for slot, frame in enumerate(history.frames) if frame not in (20,)
    ]
    assert history.known(lambda frame: False, lambda frame: 2.01 if frame < 50 else 1.0) == [
        (history.frames.index(frame), frame)
        for frame in sorted(history.frames, key=history.frames.index)
        if frame >= 50
    ]


def test_a_jump_does_not_hide_what_moves(walked):
    history = DepthHistory(walked.camera)
    history.predicted(2.0, 1.5)
    assert history.off == MOST_OFF
    history.predicted(0.001, 0.002)
    np.testing.assert_allclose(history.off, (FADES * 0.1, FADES * 0.1))


@pytest.mark.parametrize(
    ("counts", "is_recovered", "is_occluded"),
    [([31, 100], False, True), ([30, 100], False, False), ([31, 100], True, False), ([0, 0], False, False)],
)
def test_a_frame_of_which_much_moves_is_not_mapped(walked, counts, is_recovered, is_occluded):
    moving = SlamSystem(load_config("places", overrides=["device=cpu"]), walked.camera)._moving
    found = torch.tensor(counts, dtype=torch.int32)
    moving._coming = HostEvent(), found
    tracked = replace(TrackedFrame.untracked(torch.zeros(7), lost=False), recovered=is_recovered)
    assert moving.judged(StaticFrame(None, found=found), tracked).occluded == is_occluded


def test_nothing_moves_in_the_frames_of_a_rolling_shutter():
    capture = Capture(width=160, height=120, rolling_shutter_ms=30)
    data = PlacesDataset("hall", "fast_turns", "exact", 50, 9, capture=capture)
    system = SlamSystem(load_config("places", overrides=["device=cpu"]), data.camera)
    shares = [system.process(frame).moving_share for frame in data]
    assert max(share for share in shares[15:] if share is not None) < NOTICED  # the readout has to be found first


def test_anchors_are_of_the_recording_alone():
    times = {0: 1.7, 5: 0.3, 12: 0.9, 20: 1.6, 25: 0.35, 28: 0.1}
    history = SimpleNamespace(feature_rows=lambda: list(times), seconds_since=times.get)
    assert MovingObjects._anchors(0, history) == [0, 12, 25]
    assert MovingObjects._anchors(10, history) == [12, 20, 25]
    assert MovingObjects._anchors(26, history) == []


def test_without_image_features_none_are_kept(walked):
    config = load_config("places", overrides=["device=cpu", "tracking.features=false", "mapping.first_iterations=20"])
    system = SlamSystem(config, walked.camera)
    shares = [system.process(frame).moving_share for frame in walked]
    assert max(share for share in shares if share is not None) > 0.05
    assert system.state.features.frames == []


def test_without_depth_keyframes_nothing_is_looked_for(walked):
    config = load_config("places", overrides=["device=cpu", "tracking.depth_keyframes=false"])
    assert SlamSystem(config, walked.camera).state.depth_history is None


def test_features_of_what_is_left_out_go():
    points = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 2]], np.float32)
    positions = np.array([[0, 0], [1, 0], [2.6, 1]], np.float32)
    features = ImageFeatures(np.zeros((3, 32), np.uint8), positions, points, np.zeros(3, np.float32))
    depth = np.array([[0, 0, 0, 0], [0, 0, 0, 5]], np.uint16)
    np.testing.assert_array_equal(features.where_known(depth).positions, positions[1:])


def test_people_do_not_lead_the_camera_along():
    capture = Capture(width=160, height=120)
    data = PlacesDataset("apartment", "stop_and_go", "structured_light", 60, 13, capture=capture, people=1)
    errors = {}
    for option in ("true", "false"):
        config = load_config("places", overrides=["device=cpu", f"tracking.moving_objects={option}"])
        system = SlamSystem(config, data.camera)
        reports = [system.process(frame) for frame in data]
        assert not reports[-1].lost
        moved, found = (
            inverse(first) @ last
            for first, last in ((data.poses()[0], data.poses()[-1]), (reports[0].pose, reports[-1].pose))
        )
        errors[option] = np.linalg.norm((inverse(moved) @ found)[:3, 3])
    assert errors["true"] < 0.04
    assert errors["false"] > 2 * errors["true"]


def test_a_checkpoint_keeps_what_was_found(walked, tmp_path):
    config = load_config("places", overrides=["device=cpu", "mapping.first_iterations=20"])
    whole, first, second = (SlamSystem(config, walked.camera) for _ in range(3))
    poses, moving = [], []
    for frame in walked:
        poses.append(whole.process(frame).pose)
        moving.append(whole.state.depth_history.moving)
    stop = (
        next(frame for frame in moving if frame >= 0) + 1
    )  # the frame before was looked at, and nobody has read what was found
    assert 3 < stop < 40
    for index in range(stop):
        first.process(walked[index])
    assert first.state.depth_history.looked == stop - 1
    path = tmp_path / "checkpoint.safetensors"
    source = {"data": {"frames": len(walked)}, "next": stop, "clock": {"frames": stop, "wall_s": 1.0, "decode_s": 0.1}}
    write_snapshot(path, take_snapshot(first.state, config, source, copy=False))
    load_checkpoint(path, second.state, config)
    for index in range(stop, len(walked)):
        np.testing.assert_array_equal(second.process(walked[index]).pose, poses[index])
    assert second.state.depth_history.moving == whole.state.depth_history.moving > stop


def test_a_checkpoint_has_the_features_of_a_frame_that_was_watched(walked, tmp_path):
    config = load_config("places", overrides=["device=cpu", "mapping.first_iterations=20"])
    first, second = (SlamSystem(config, walked.camera) for _ in range(2))
    for frame in walked:
        first.process(frame)
    assert first.state.depth_history.moving > len(walked) - 10
    path = tmp_path / "checkpoint.safetensors"
    source = {"data": {"frames": 60}, "next": 60, "clock": {"frames": 60, "wall_s": 1.0, "decode_s": 0.1}}
    write_snapshot(path, take_snapshot(first.state, config, source, copy=False))
    load_checkpoint(path, second.state, config)
    here, there = (system.state.newest.features() for system in (first, second))
    np.testing.assert_array_equal(here.descriptors, there.descriptors)
    np.testing.assert_array_equal(here.points, there.points)
    np.testing.assert_array_equal(here.beyond_m, there.beyond_m)
