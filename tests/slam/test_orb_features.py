"""Compiled image features against OpenCV's ORB, and on images that have none."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from spslam.image_library import images_shared
from spslam.slam.image_features import (
    CELL_COLUMNS,
    COUNT,
    DETECTED,
    EDGE_PX,
    FAST_THRESHOLD,
    detect,
    features_of_images,
)
from tests.system.sequences import Recorded


def textured(size, seed):
    """Edges, blobs and noise of all scales."""
    generator = np.random.default_rng(seed)
    width, height = size
    image = np.full((height, width), 90, np.float32)
    for _ in range(60):
        x, y = generator.integers(0, width), generator.integers(0, height)
        corner = (int(x + generator.integers(2, 60)), int(y + generator.integers(2, 60)))
        cv2.rectangle(image, (int(x), int(y)), corner, float(generator.integers(0, 255)), -1)
    return np.clip(image + generator.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def reference(intensity):
    """OpenCV's, spread over the image."""
    orb = cv2.ORB.create(nfeatures=DETECTED, fastThreshold=FAST_THRESHOLD, edgeThreshold=EDGE_PX)
    keypoints, descriptors = orb.detectAndCompute(intensity, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    positions = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
    response = np.array([keypoint.response for keypoint in keypoints], np.float32)
    column, row = (positions * (CELL_COLUMNS / intensity.shape[1])).astype(np.int64).T
    cell = row * CELL_COLUMNS + column
    order = np.lexsort((positions[:, 0], positions[:, 1], -response, cell))
    _, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, counts)
    order = order[np.lexsort((-response[order], rank))][:COUNT]
    return positions[order], descriptors[order]


@pytest.mark.parametrize("size", [(320, 240), (256, 192), (640, 480), (161, 97), (64, 48), (40, 33)])
def test_features_are_those_of_opencv(size):
    for seed in range(3):
        image = textured(size, seed)
        positions, descriptors = detect(image)
        expected, codes = reference(image)
        np.testing.assert_array_equal(positions, expected)
        # Coordinates of the pattern that are half-way between two pixels may be rounded to either; before OpenCV 5
        # images were blurred with weights of eight bits, which changes a bit in 700.
        differing = np.unpackbits(descriptors ^ codes).mean() if len(codes) else 0.0
        assert differing < (1e-4 if cv2.__version__ >= "5" else 4e-3)
    assert size[0] < 100 or len(positions) > 100


@pytest.mark.parametrize("threads", [2, 5])
def test_any_number_of_threads_finds_the_same_also_for_several_callers(threads):
    images = [textured(size, seed) for size in ((320, 240), (64, 48), (20, 20)) for seed in range(2)]
    wanted = [detect(image) for image in images]
    with images_shared(threads), ThreadPoolExecutor(3) as callers:
        for found in callers.map(lambda _: [detect(image) for image in images], range(6)):
            for (positions, descriptors), (expected, codes) in zip(found, wanted, strict=True):
                np.testing.assert_array_equal(positions, expected)
                np.testing.assert_array_equal(descriptors, codes)


def test_features_of_a_room_are_those_of_opencv():
    for frame in Recorded(2):
        image = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        positions, descriptors = detect(image)
        expected, codes = reference(image)
        np.testing.assert_array_equal(positions, expected)
        assert np.unpackbits(descriptors ^ codes).mean() < (1e-4 if cv2.__version__ >= "5" else 4e-3)


@pytest.mark.parametrize("shape", [(240, 320), (32, 400), (400, 32), (1, 1), (2, 7), (33, 33)])
def test_images_without_corners_have_no_features(shape):
    positions, descriptors = detect(np.full(shape, 128, np.uint8))
    assert positions.shape == (0, 2) and descriptors.shape == (0, 32)
    nothing = features_of_images(
        np.full(shape, 128, np.uint8), np.zeros(shape, np.uint16), Recorded(1).camera, max_depth_m=8.0
    )
    assert len(nothing) == 0


def test_an_image_need_not_be_contiguous():
    image = textured((320, 240), 5)
    positions, descriptors = detect(image)
    wide = np.zeros((240, 640), np.uint8)
    wide[:, ::2] = image
    for found, expected in zip(detect(wide[:, ::2]), (positions, descriptors), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_bright_and_dark_corners_of_full_contrast():
    generator = np.random.default_rng(3)
    image = np.where(generator.random((30, 40)) < 0.5, 0, 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    positions, _ = detect(image)
    np.testing.assert_array_equal(positions, reference(image)[0])
    assert len(positions) == COUNT
