"""Noise along rays, of walls with noise of known size."""

import cv2
import numpy as np
import pytest
import scipy.optimize

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.generated import GeneratedDataset
from spslam.errors import DatasetError
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.meshing.ray_noise import _not_negative, depth_differences, noise_along_rays

GIVEN = (1e-8, 1e-9)
SHARE = 0.75  # of the deviation


class Walls(PosedFrames):
    """A wall before the camera, nearer from column to column, with noise of a deviation that grows with depth.

    Args:
        count: frames, each 1 cm farther to the side than the last.
        deviation: of depth z, m.
        ends_m: depth at the first and last column.
        blur_px: by which the noise of neighbors is alike.
        broken: frames that can't be read.
    """

    def __init__(self, count, deviation, ends_m=(1.0, 4.0), blur_px=0.7, broken=()):
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 1, 3] = 0.01 * np.arange(count)
        super().__init__(GeneratedDataset(frames=1, width=160, height=120), np.arange(count), poses)
        inverse = np.linspace(1 / ends_m[0], 1 / ends_m[1], 160)
        self.__dict__.update(deviation=deviation, exact=np.tile(1 / inverse, (120, 1)), blur_px=blur_px, broken=broken)

    def depth(self, position):
        return self[position].depth

    def __getitem__(self, position):
        if position in self.broken:
            raise DatasetError("frame can't be read")
        noise = cv2.GaussianBlur(np.random.default_rng(position).normal(size=(120, 160)), (0, 0), self.blur_px)
        depth = self.exact + self.deviation(self.exact) * noise / noise.std()
        color = np.zeros((120, 160, 3), np.uint8)
        return RgbdFrame(int(position), float(position), color, depth.astype(np.float32))


def deviations(noise, *depths_m):
    return [np.sqrt(noise[0] + noise[1] * z**4) for z in depths_m]


@pytest.mark.parametrize(
    "deviation",
    [lambda z: 0.004 * z**2, lambda z: 0.01 + 0 * z, lambda z: np.sqrt(0.004**2 + (0.002 * z**2) ** 2)],
    ids=["growth", "floor", "both"],
)
def test_noise_of_a_wall(deviation):
    found = noise_along_rays(Walls(30, deviation), GIVEN)
    np.testing.assert_allclose(
        deviations(found, 1.2, 2.0, 3.5), SHARE * deviation(np.array([1.2, 2.0, 3.5])), rtol=0.12
    )


def test_noise_that_varies_from_pixel_to_pixel_has_the_same_size():
    """Distances along the normals of four pixels are a fraction of it."""
    sharp, smooth = (noise_along_rays(Walls(30, lambda z: 0.004 * z**2, blur_px=px), GIVEN) for px in (0.5, 4.0))
    np.testing.assert_allclose(deviations(sharp, 2.0, 3.5), deviations(smooth, 2.0, 3.5), rtol=0.15)


def test_one_depth_says_nothing_of_growth():
    found = noise_along_rays(Walls(30, lambda z: 0.01 + 0 * z, ends_m=(2.0, 2.2)), (1e-8, 1e-6))
    assert found[1] == 1e-6
    np.testing.assert_allclose(deviations(found, 2.1), [SHARE * 0.01], rtol=0.1)


def test_never_below_what_tracking_measured():
    assert noise_along_rays(Walls(30, lambda z: 0.001 + 0 * z), (1e-4, 1e-5)) == (1e-4, 1e-5)


@pytest.mark.parametrize(
    "frames",
    [
        Walls(0, lambda z: 0.01 + 0 * z),
        Walls(1, lambda z: 0.01 + 0 * z),
        Walls(20, lambda z: 0 * z),
        Walls(20, lambda z: 0.01 + 0 * z, broken=range(20)),
    ],
    ids=["none", "one", "exact", "unreadable"],
)
def test_as_given_where_nothing_can_be_compared(frames):
    assert noise_along_rays(frames, GIVEN) == pytest.approx(GIVEN)


def test_frames_that_cannot_be_read_do_not_count():
    found = noise_along_rays(Walls(30, lambda z: 0.004 * z**2, broken=(0, 13)), GIVEN)
    np.testing.assert_allclose(deviations(found, 2.0), [SHARE * 0.016], rtol=0.12)


def test_nearer_frames_where_farther_ones_see_something_else():
    """Frames 1 m apart see nothing of what those ten frames before did."""
    frames = Walls(12, lambda z: 0.004 * z**2, ends_m=(1.0, 2.0))
    frames.poses[:, 0, 3] = 0.3 * np.arange(12)
    frames.__dict__["exact"] = np.full((120, 160), 2.0)
    found = noise_along_rays(frames, GIVEN)
    np.testing.assert_allclose(deviations(found, 2.0), [SHARE * 0.016], rtol=0.12)


def test_differences_are_of_one_surface():
    """The second image has a box before the left half of the wall, and nothing in its last rows."""
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    wall, other = np.full((120, 160), 2.0, np.float32), np.full((120, 160), 2.005, np.float32)
    other[:, :80], other[100:] = 1.5, 0
    found, share = depth_differences(wall, other, np.eye(4), camera)
    np.testing.assert_allclose(found[1], -0.005, atol=1e-6)
    assert share == pytest.approx(79 * 99 / (160 * 120), abs=0.02)
    nowhere, share = depth_differences(wall, other, np.diag([-1.0, 1, -1, 1]), camera)
    assert nowhere.shape == (2, 0) and share == 0


@pytest.mark.filterwarnings("error")
def test_depth_that_is_no_number_does_not_count():
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    wall = np.full((120, 160), 2.0, np.float32)
    wall[::2, ::2], wall[1::2, ::2] = np.inf, np.nan
    found, _ = depth_differences(wall, np.full_like(wall, 2.005), np.eye(4), camera)
    assert found.shape[1] > 5000
    np.testing.assert_allclose(found[1], -0.005, atol=1e-6)


def test_a_far_wall_of_noisy_depth_is_one_surface():
    """Stereo: noise of a pixel's width, of which tracking measured a third."""
    frames = Walls(40, lambda z: 0.004 * z**2, ends_m=(3.9, 4.1), blur_px=0.7)
    volume = fuse_frames(frames, FusionOptions(0.02, 500, (1e-8, (0.004 / 3) ** 2)))
    mesh = extract_fused_mesh(volume, min_part_m2=0)
    inner = np.abs(mesh.vertices[:, :2]).max(1) < 1
    assert np.abs(mesh.vertices[inner, 2] - 4).max() < 0.1  # 0.22 with the noise that tracking measured
    edges = np.diff(mesh.vertices[mesh.faces[inner[mesh.faces].all(1)]], axis=1)
    area_m2 = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
    assert area_m2 < 1.08 * 4  # 1.13 times with the noise that tracking measured


def test_numbers_that_are_not_negative_are_those_of_scipy():
    random = np.random.default_rng(0)
    zeros = 0
    for _ in range(200):
        matrix, right = random.random((6, 2)), random.normal(0.3, 1, 6)
        expected, _ = scipy.optimize.nnls(matrix, right)
        np.testing.assert_allclose(_not_negative(matrix, right), expected, atol=1e-12)
        zeros += (expected == 0).sum()
    assert 50 < zeros < 350
