"""Whether a recording is plausible: sound ones pass, and ones that are wrong in one way are named."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from experiments.capture_faults import FAULTS as FAULTS_OF_CAPTURE
from experiments.fault_injection import black_out, cover_garbage, cover_near, cover_wall
from experiments.wrong_inputs import LATE
from experiments.wrong_recordings import FAULTS, Fault, WrongRecording
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.places import Capture, PlacesDataset
from spslam.datasets.plausibility import Finding, check_first_frames, folded, require_sound, turning
from spslam.datasets.plausibility.edges import TURNS, EdgeMatch
from spslam.datasets.plausibility.flow_fit import Points, fit_flow, fit_flows
from spslam.datasets.plausibility.intrinsics import CERTAIN_SIGMAS, estimate_lens
from spslam.datasets.plausibility.lens import FOCAL, RADIAL, SHIFT_X, Lens
from spslam.datasets.plausibility.pairing import pairing_findings
from spslam.datasets.plausibility.tracks import Followed, follow
from spslam.datasets.plausibility.turning import lag_findings
from spslam.datasets.plausibility.views import View, read_views
from spslam.errors import DatasetError

FRAMES = 60


class Kept(RgbdDataset):
    """A dataset whose frames are rendered once."""

    def __init__(self, dataset):
        self.name, self.camera, self.depth_range = dataset.name, dataset.camera, (0.1, 10.0)
        self.frames = [dataset[i] for i in range(len(dataset))]
        self.times, self.given_poses = dataset.timestamps(), dataset.poses()

    def __len__(self):
        return len(self.frames)

    def timestamps(self):
        return self.times

    def poses(self):
        return self.given_poses

    def read(self, index):
        frame = self.frames[index]
        return type(frame)(index, frame.timestamp, frame.color.copy(), frame.depth.copy(), frame.pose)


@pytest.fixture(scope="module")
def apartment():
    return Kept(PlacesDataset("apartment", "handheld", "structured_light", FRAMES, capture=Capture(color_noise=2)))


def found(recording):
    return {finding.kind: finding for finding in check_first_frames(recording)}


def test_a_sound_recording_has_no_finding(apartment):
    assert check_first_frames(WrongRecording(apartment, FAULTS["none"])) == []
    assert check_first_frames(WrongRecording(apartment, FAULTS["none"], with_poses=False)) == []


REFUSED = {
    "depth is noise": ("depth", "depth is noise"),
    "focal length x 1.1": ("intrinsics", "focal length looks 1"),
    "fx, fy of twice the size, cx, cy too": ("intrinsics", "the principal point lies at"),
    "cx off by 10 % of f": ("intrinsics", "principal point (cx, cy) looks shifted"),
    "depth x 1.1": ("scale", "depth 0.909 times as large would fit"),
    "depth x 5": ("scale", "depth 0.2 times as large would fit"),
    "depth x 1000": ("scale", "the depth scale looks wrong"),
    "depth of one value": ("depth", "all depth is the same"),
    "depth mirrored": ("pairing", "mirrored left to right"),
    "disparity as depth": ("pairing", "inverse depth"),
    "both upside down": ("mirrored", "mirrored upside down"),
    "color frozen": ("frozen color", "color is frozen"),
    "depth frozen": ("frozen depth", "depth is frozen"),
    "depth every fifth frame": ("frozen depth", "depth is frozen"),
    "every frame five times": ("frozen", "frames are repeated while the poses move"),
    "frames shuffled": ("order", "out of order"),
}


def noise(read, i, count):
    frame = read(i)
    depth = np.random.default_rng(i).uniform(0.5, 6, frame.depth.shape)
    return replace(frame, depth=depth.astype(np.float32))


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_named_and_certain(apartment, name):
    kind, words = REFUSED[name]
    fault = Fault(frame=noise) if name == "depth is noise" else FAULTS[name]
    finding = found(WrongRecording(apartment, fault))[kind]
    assert finding.certain, finding
    assert words in str(finding)
    assert finding.remedy


WARNED = {
    "depth of 8 bits": ("depth", "stored in 8 bits or in coarse units"),
    "poses world-to-camera": ("poses", "world-to-camera"),
    "time stamps all zero": ("times", "do not ascend"),
}


@pytest.mark.parametrize("name", WARNED)
def test_what_does_not_spoil_the_trajectory_is_a_doubt(apartment, name):
    kind, words = WARNED[name]
    finding = found(WrongRecording(apartment, FAULTS[name]))[kind]
    assert not finding.certain
    assert words in str(finding)


def stood_still(read, i, count):
    """The first frame again and again, with noise of its own each time."""
    frame, random = read(0), np.random.default_rng(i)
    color = np.clip(frame.color + random.normal(0, 2, frame.color.shape), 0, 255).astype(np.uint8)
    depth = frame.depth * (1 + random.normal(0, 0.002, frame.depth.shape))
    return replace(frame, color=color, depth=depth.astype(np.float32))


def covered(read, i, count):
    """A lens that is covered three times."""
    frame = read(i)
    if i % 16 < 8:
        return frame
    return replace(frame, color=np.zeros_like(frame.color), depth=np.zeros_like(frame.depth))


def away_and_back(count):
    """As of a camera that turns back, and whose frames in between are missing."""
    return np.array([*range(24), *range(23, 3, -1), *range(40, 50), *range(4, 24)])


@pytest.mark.parametrize(
    "fault",
    [Fault(frame=stood_still), Fault(frame=covered), FAULTS_OF_CAPTURE["flicker"], Fault(order=away_and_back)],
    ids=["still", "covered", "flickering", "back"],
)
def test_what_cameras_do_is_no_wrong_order(apartment, fault):
    """All lie nearer to views elsewhere than to those beside them, or jump once, and no frame is out of order."""
    assert "order" not in found(WrongRecording(apartment, fault, with_poses=False))


def test_text_over_the_image_is_no_wrong_depth():
    """Its points stand still, which depth contradicts: a depth image upside down seemed to explain them better."""
    stairs = PlacesDataset("stairwell", "walking", "structured_light", 160, 405)
    assert check_first_frames(WrongRecording(stairs, FAULTS_OF_CAPTURE["text"], with_poses=False)) == []


def test_a_jump_after_a_black_out_does_not_stop_a_short_run(apartment):
    """With few views one jump is a large share of the steps."""
    order = np.array([*range(12), *range(12, 18), *range(4, 12)])

    def black(read, i, count):
        frame = read(i)
        if not 12 <= i < 18:
            return frame
        return replace(frame, color=np.zeros_like(frame.color), depth=np.zeros_like(frame.depth))

    findings = check_first_frames(WrongRecording(apartment, Fault(frame=black, order=lambda count: order)))
    assert not any(finding.certain for finding in findings)


def palm(frame, random):
    """A hand 6 cm before the lens, nearer than any depth scale in use would put a room."""
    frame.color[:] = random.integers(20, 40, frame.color.shape)
    frame.depth[:] = 0.06 + random.normal(0, 0.001, frame.depth.shape)


def fragments(count):
    """Five pieces of a recording that was switched on and off."""
    return np.array([*range(12), *range(30, 40), *range(6, 14), *range(34, 44), *range(2, 12)])


@pytest.mark.parametrize("change", [black_out, cover_near, cover_garbage, cover_wall, palm])
@pytest.mark.parametrize("frames", [range(30), range(20, 50)], ids=["at the start", "later"])
def test_a_lens_that_is_covered_for_a_second_does_not_stop_a_run(apartment, change, frames):
    def covered(read, i, count):
        frame = read(i)
        if i in frames:
            change(frame, np.random.default_rng(i))
        return frame

    findings = check_first_frames(WrongRecording(apartment, Fault(frame=covered)))
    assert not any(finding.certain for finding in findings), findings


def test_gaps_do_not_stop_a_run():
    desk = Kept(
        PlacesDataset("desk", "stop_and_go", "structured_light", FRAMES, seed=5, capture=Capture(color_noise=2))
    )
    finding = found(WrongRecording(desk, Fault(order=fragments)))["order"]
    assert "24% of the views" in finding.text
    assert not finding.certain


def test_a_camera_that_stalls_does_not_stop_a_run(apartment):
    """A third of the views repeat the one before, while whatever measured the poses went on."""
    recording = WrongRecording(apartment, Fault(frame=lambda read, i, count: read(10 if 10 <= i < 26 else i)))
    finding = found(recording)["frozen"]
    assert "while the poses move" in finding.text
    assert not finding.certain


def test_a_scale_that_only_poses_could_show_is_not_seen_without_them(apartment):
    assert check_first_frames(WrongRecording(apartment, FAULTS["depth x 1.1"], with_poses=False)) == []


def test_findings_do_not_depend_on_anything_but_the_frames(apartment):
    recording = WrongRecording(apartment, FAULTS["fx x 1.1"])
    assert check_first_frames(recording) == check_first_frames(recording)


# Edges of color lie 10 % of the width to the right of those of depth.
TO_THE_RIGHT = EdgeMatch(0.1, 0.5, 0.1, 0.05, 0.002, np.array([0.1, 0, 0, 0]), dict.fromkeys(TURNS, 0.0))


def test_edges_that_lie_elsewhere_are_a_matter_of_registration():
    lens = Lens(PlacesDataset(frames=1).camera, 2.0)
    shifted = TO_THE_RIGHT
    (finding,) = pairing_findings([], [], lens, shifted)
    assert finding.certain
    assert str(finding).startswith("color and depth are not registered: their edges are up to 10 % of the width apart")
    assert pairing_findings([], [], lens, replace(shifted, score=0.45)) == []
    assert pairing_findings([], [], lens, replace(shifted, misfit=0.03)) == []
    # A part of the image where they lie on each other.
    assert pairing_findings([], [], lens, replace(shifted, least_offset=0.01)) == []


@pytest.mark.parametrize("turned", [0.0, 0.6])
def test_edges_say_nothing_that_the_motion_of_color_speaks_against(apartment, turned):
    """Depth explains how color moves where it is, and not where a few edges that lie beside others would have it."""
    views = read_views(apartment, range(0, FRAMES, 2))
    edges = replace(TO_THE_RIGHT, turned_scores=dict.fromkeys(TURNS, turned))
    lens = Lens(apartment.camera, 2.0)
    assert pairing_findings(views, [], lens, edges)
    assert pairing_findings(views, follow(views).segments, lens, edges) == []


def test_depth_is_moved_to_where_edges_want_it():
    depth = np.zeros((60, 80), np.float32)
    depth[20:40, 30:50] = 2.0
    np.testing.assert_array_equal(TO_THE_RIGHT.moved(depth), np.roll(depth, 8, axis=1))
    larger = replace(TO_THE_RIGHT, similarity=np.array([0, 0, 0.2, 0])).moved(depth)
    assert np.count_nonzero(larger) == pytest.approx(1.44 * np.count_nonzero(depth), rel=0.02)
    quarter = replace(TO_THE_RIGHT, similarity=np.array([0, 0.1, -1, 1])).moved(depth)  # clockwise, then 8 px down
    assert np.argwhere(quarter).min(axis=0) == pytest.approx([28, 30]) and (quarter > 0).sum() == (depth > 0).sum()


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["handheld", "walking"])
def test_a_hall_whose_pillars_are_as_bright_as_its_walls_passes(motion):
    """A lamp and a poster lie beside the pillars, whose edges color does not show: they seemed not to be registered."""
    recording = PlacesDataset("hall", motion, "structured_light", 250, seed=613)
    recording.depth_range = (0.1, 10.0)
    assert "registration" not in found(recording)


def test_a_dataset_that_is_not_registered_is_not_expected_to_be(apartment):
    recording = WrongRecording(apartment, FAULTS["depth mirrored"])
    recording.is_registered = False
    assert not {"registration", "pairing"} & found(recording).keys()


CAMERA = PlacesDataset(frames=1).camera


def turned_points(angle, lens, seed=0, noise_px=0.1):
    """Points of a camera that has turned by an angle (rad) and moved by 10 and 5 cm."""
    random = np.random.default_rng(seed)
    pixels = random.uniform((0, 0), (CAMERA.width, CAMERA.height), (200, 2))
    depth = random.uniform(1, 4, 200)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    last = lens.pixels(lens.points(pixels, depth) @ turn.T + (0.1, 0, 0.05))
    return Points(pixels, depth, last + random.normal(0, noise_px, last.shape))


@pytest.mark.parametrize(
    ("number", "angles", "seconds", "is_certain"),
    [
        (SHIFT_X, (0.2, 0.2), 4.0, True),
        (SHIFT_X, (0.2, 0.2), 0.1, False),  # 2 rad/s: colors that are 20 ms late would look like that
        (SHIFT_X, (0.2, -0.2), 0.1, True),  # to and fro, late colors would not
        (RADIAL, (0.2, 0.2), 0.1, True),
    ],
)
def test_a_camera_that_turns_one_way_says_less_of_its_center(number, angles, seconds, is_certain):
    off = np.zeros(7)
    off[number] = 0.08 if number == SHIFT_X else 0.2
    true = Lens(CAMERA, 2.0, off)
    segments = [turned_points(angle, true, i) for i, angle in enumerate(angles)]
    estimate = estimate_lens(segments, Lens(CAMERA, 2.0), [seconds] * 2)
    assert estimate.chosen[0] == number
    assert (estimate.sigmas > CERTAIN_SIGMAS) == is_certain


def test_late_colors_and_a_rolling_shutter_of_fast_turns_are_not_refused():
    """The principal point looked shifted by a tenth of the image."""
    recording = PlacesDataset("arcade", "fast_turns", "structured_light", 150, seed=41, capture=LATE)
    recording.depth_range = (0.1, 10.0)
    assert not [finding for finding in check_first_frames(recording) if finding.certain]


def test_a_focal_length_is_estimated_from_exact_points():
    wrong = np.zeros(7)
    wrong[FOCAL] = 0.1
    points = turned_points(0.2, Lens(CAMERA, 2.0), noise_px=0.0)
    fit = fit_flow(points, Lens(CAMERA, 2.0, wrong), [FOCAL])
    assert fit.numbers[FOCAL] == pytest.approx(0, abs=1e-3)
    assert fit.error_px < 0.01
    assert fit.translation == pytest.approx([0.1, 0, 0.05], abs=1e-3)


def test_pairs_of_views_are_fitted_together_as_each_by_itself():
    """They have different numbers of points, motions and errors."""
    lens = Lens(CAMERA, 2.0, np.array([0.02, 0.01, -0.01, 0.01, 0.1, 0.05, 0.02]))
    pairs = [turned_points(0.1 * k, lens, k) for k in range(4)]
    pairs[1] = Points(*(each[:41] for each in (pairs[1].pixels_first, pairs[1].depth, pairs[1].pixels_last)))
    for free in ((), (FOCAL, RADIAL)):
        for pair, fit in zip(pairs, fit_flows(pairs, Lens(CAMERA, 2.0), free), strict=True):
            alone = fit_flow(pair, Lens(CAMERA, 2.0), free)
            np.testing.assert_allclose(fit.motion, alone.motion, atol=1e-8)
            np.testing.assert_allclose(fit.numbers, alone.numbers, atol=1e-8)
            np.testing.assert_allclose(fit.information, alone.information, rtol=1e-5, atol=1e-5)
            assert fit.error_px == pytest.approx(alone.error_px, abs=1e-8)
    assert fit_flows([], lens) == []


def test_derivatives_of_pixels_by_points_are_those_of_differences():
    lens = Lens(CAMERA, 2.0, np.array([0.02, 0.01, -0.01, 0.01, 0.1, 0.05, 0.02]))
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 3), (20, 3))
    pixels, by_point = lens.pixels_and_derivatives(points)
    np.testing.assert_allclose(pixels, lens.pixels(points))
    for axis, shift in enumerate(1e-6 * np.eye(3)):
        differences = (lens.pixels(points + shift) - lens.pixels(points - shift)) / 2e-6
        np.testing.assert_allclose(by_point[..., axis], differences, rtol=1e-5, atol=1e-3)


def test_findings_of_a_kind_are_folded_with_their_number():
    doubt, certain = Finding("scale", "maybe"), Finding("scale", "surely", "mend it", certain=True)
    kept = folded([doubt, Finding("order", "mixed"), certain, doubt])
    assert [(finding.text, finding.times) for finding in kept] == [("surely", 3), ("mixed", 1)]
    assert str(kept[0]) == "surely (3 times); mend it"


def test_doubts_are_no_reason_to_stop():
    require_sound([Finding("scale", "maybe")], "data")
    with pytest.raises(DatasetError, match=r"data: the first frames do not fit together: surely.*run\.data_check=warn"):
        require_sound([Finding("scale", "maybe"), Finding("scale", "surely", certain=True)], "data")


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["exact", "stereo", "time_of_flight", "phone_lidar"])
@pytest.mark.parametrize("place", ["room", "stairwell", "hall"])
def test_sound_places_pass(place, sensor):
    recording = PlacesDataset(place, "walking", sensor, 300, seed=5, capture=Capture(color_noise=2))
    recording.depth_range = (0.1, 10.0)
    assert check_first_frames(recording) == []


@pytest.mark.parametrize(("motion", "seed"), [("walking", 101), ("handheld", 103)])
def test_a_sound_place_without_texture_passes(motion, seed):
    """Its best corners lie on edges, along which they were followed to anywhere: the first one was refused."""
    assert check_first_frames(PlacesDataset("stairwell", motion, "structured_light", 200, seed, texture=0.0)) == []


def test_color_of_another_time_is_a_doubt_with_that_time():
    arcade = PlacesDataset("arcade", "handheld", "structured_light", 60, seed=0)
    assert check_first_frames(arcade) == []
    late = found(WrongRecording(arcade, FAULTS["color 5 frames late"]))["pairing"]
    assert "color images look taken 0.17 s before their depth images" in late.text and not late.certain


@pytest.mark.parametrize("unit", [0.0, 1e3])
def test_time_stamps_in_other_units_say_nothing_of_a_lag(unit):
    arcade = PlacesDataset("arcade", "handheld", "structured_light", 60, seed=0)
    late = read_views(WrongRecording(arcade, FAULTS["color 5 frames late"]), range(0, 48, 2))
    lens = Lens(arcade.camera, 3.0)
    assert [finding.kind for finding in lag_findings(late, lens)] == ["pairing"]
    assert lag_findings([replace(view, timestamp=unit * view.timestamp) for view in late], lens) == []


def test_small_turns_alone_tell_no_lag(monkeypatch):
    """As in a hall whose walls are out of range: depth shows no turn at all, and small ones of color fit at any lag."""
    arcade = PlacesDataset("arcade", "handheld", "structured_light", 60, seed=0)
    views = read_views(arcade, range(0, 48, 2))
    turns = np.zeros((len(views) - 1, 3))
    turns[:, 1] = np.radians([*np.linspace(2, 10, 12), *np.full(11, 0.4)])
    still = np.full_like(turns, np.radians(0.05))
    monkeypatch.setattr(turning, "_turns_of_color", lambda *_: turns)
    monkeypatch.setattr(turning, "_turns_of_depth", lambda *_: still)
    assert lag_findings(views, Lens(arcade.camera, 3.0)) == []
    monkeypatch.setattr(turning, "_turns_of_depth", lambda *_: np.roll(turns, 3, axis=0))
    assert [finding.kind for finding in lag_findings(views, Lens(arcade.camera, 3.0))] == ["pairing"]


def test_color_may_be_as_late_as_tracking_measures():
    arcade = PlacesDataset("arcade", "handheld", "structured_light", 60, seed=0, capture=Capture(color_delay_ms=70))
    assert check_first_frames(arcade) == []


def test_points_on_edges_and_of_noise_are_not_followed():
    def view(gray):
        return View.of(RgbdFrame(0, 0.0, np.stack([gray] * 3, -1).astype(np.uint8), np.ones(gray.shape, np.float32)))

    row, column = np.mgrid[:240, :320]
    random = np.random.default_rng(0)
    edge = np.where(column + 0.21 * row > 200, 170.0, 90.0)
    squares = np.where((column // 20 + row // 20) % 2, 170.0, 90.0)
    for image, is_followed in ((edge, False), (np.full(edge.shape, 128.0), False), (squares, True)):
        noisy = image + random.normal(0, 2, image.shape)
        assert bool(follow([view(noisy)] * 2).segments) == is_followed


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.9, 0.95, 1.05, 1.1])
@pytest.mark.parametrize("sensor", ["exact", "stereo", "time_of_flight"])
def test_focal_lengths_off_by_5_and_10_percent_are_refused(sensor, factor):
    dataset = PlacesDataset("room", "handheld", sensor, 600, seed=5, capture=Capture(color_noise=2))
    recording = WrongRecording(dataset, FAULTS[f"focal length x {factor:g}"])
    assert found(recording)["intrinsics"].certain


def test_points_are_not_followed_again_where_views_are_added(monkeypatch, apartment):
    views = read_views(apartment, range(0, 24, 2))
    expected, flows = follow(views), []
    followed = Followed()
    follow(views[:8], followed)
    flow = cv2.calcOpticalFlowPyrLK
    monkeypatch.setattr(cv2, "calcOpticalFlowPyrLK", lambda *args, **options: flows.append(1) or flow(*args, **options))
    tracks = follow(views, followed)
    with_memory = len(flows)
    follow(views)
    assert 0 < with_memory < len(flows) - with_memory
    assert (tracks.steps, tracks.broken) == (expected.steps, expected.broken)
    for segment, other in zip(tracks.segments, expected.segments, strict=True):
        assert (segment.first, segment.last) == (other.first, other.last)
        assert np.array_equal(segment.pixels_first, other.pixels_first)
        assert np.array_equal(segment.pixels_last, other.pixels_last)
