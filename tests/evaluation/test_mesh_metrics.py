from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.camera import Camera
from spslam.datasets.generated import GeneratedDataset
from spslam.evaluation.mesh_metrics import evaluate_surface, observed_mask, observed_samples, surface_metrics
from spslam.evaluation.surface import TriangleSurface
from spslam.geometry import pose_from


def square(width: float = 1.0, height: float = 0.0) -> TriangleSurface:
    """A horizontal rectangle, `width` by 1 m, at a height."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * [width, 1, 1] + [0, 0, height]
    return TriangleSurface(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), dtype=bool)


def brute_force_metrics(accuracy, completeness):
    expected = {"accuracy_cm": 100 * sum(accuracy) / len(accuracy)}
    expected["completeness_cm"] = 100 * sum(completeness) / len(completeness)
    for cm in (5, 1):
        a = 100 * sum(distance < cm / 100 for distance in accuracy) / len(accuracy)
        c = 100 * sum(distance < cm / 100 for distance in completeness) / len(completeness)
        expected |= {f"accuracy_{cm}cm": a, f"completeness_{cm}cm": c, f"f1_{cm}cm": 2 * a * c / (a + c)}
    return expected


def test_metrics_agree_with_brute_force():
    accuracy, completeness = np.random.default_rng(0).exponential(0.03, (2, 500))
    found = surface_metrics(accuracy, completeness[:300])
    assert found == pytest.approx(brute_force_metrics(accuracy.tolist(), completeness[:300].tolist()))


def test_metrics_of_triangles_agree_with_brute_force_over_points():
    generator = np.random.default_rng(0)
    corners = generator.uniform(size=(2, 40, 3)) * 0.2
    first, second = (TriangleSurface(vertices, np.arange(39).reshape(13, 3)) for vertices in corners)
    metrics = evaluate_surface(first, second, everywhere, count=400)
    a, b = first.sample_surface(400), second.sample_surface(400)
    dense_a, dense_b = first.sample_surface(20000, seed=1), second.sample_surface(20000, seed=1)
    accuracy = np.linalg.norm(a[:, None] - dense_b[None], axis=2).min(axis=1)
    completeness = np.linalg.norm(b[:, None] - dense_a[None], axis=2).min(axis=1)
    # The dense points are 1 mm apart.
    assert metrics["accuracy_cm"] == pytest.approx(100 * accuracy.mean(), abs=0.05)
    assert metrics["completeness_cm"] == pytest.approx(100 * completeness.mean(), abs=0.05)


def test_metrics_of_shifted_and_partial_surfaces():
    shifted = evaluate_surface(square(height=0.02), square(), everywhere, 5000)
    assert shifted["accuracy_cm"] == pytest.approx(2, abs=1e-6)
    assert (shifted["f1_5cm"], shifted["f1_1cm"]) == (100, 0)
    half = evaluate_surface(square(width=0.5), square(), everywhere, 20000)
    assert half["accuracy_1cm"] == 100
    # Half of the square plus 5 or 1 cm. The standard error with 20,000 points is 0.35 %; the tolerance is 3 times that.
    assert half["completeness_5cm"] == pytest.approx(55, abs=1)
    assert half["completeness_1cm"] == pytest.approx(51, abs=1)
    assert half["f1_5cm"] == pytest.approx(2 * 100 * 55 / 155, abs=1)


def test_metrics_without_points():
    none = TriangleSurface(np.zeros((0, 3)), np.zeros((0, 3), int))
    for pair in ((none, square()), (square(), none), (none, none)):
        metrics = evaluate_surface(*pair, everywhere, 10)
        assert metrics["f1_5cm"] == metrics["f1_1cm"] == 0
        assert "accuracy_cm" not in metrics
        assert "completeness_cm" not in metrics


def brute_force_observed(points, depths, poses, camera, tolerance):
    observed = []
    for point in points:
        seen = False
        for depth, pose in zip(depths, poses, strict=True):
            if not np.isfinite(pose).all():
                continue
            x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
            if z <= 0:
                continue
            u, v = (
                int(np.floor(x / z * camera.fx + camera.cx + 0.5)),
                int(np.floor(y / z * camera.fy + camera.cy + 0.5)),
            )
            if 0 <= u < camera.width and 0 <= v < camera.height:
                seen |= depth[v, u] > 0 and z <= depth[v, u] + tolerance
        observed.append(seen)
    return np.array(observed)


def test_observed_mask_agrees_with_brute_force():
    generator = np.random.default_rng(1)
    camera = Camera(20, 16, 15, 15, 9.5, 7.5)
    poses = pose_from(Rotation.random(6, random_state=1).as_matrix(), generator.normal(scale=0.3, size=(6, 3)))
    depths = generator.uniform(0.5, 2, (6, 16, 20)) * (generator.uniform(size=(6, 16, 20)) > 0.2)
    poses[3] = np.nan
    points = generator.normal(size=(1500, 3))
    mask = observed_mask(points, depths, poses, camera, 0.1)
    assert 0.1 < mask.mean() < 0.9
    np.testing.assert_array_equal(mask, brute_force_observed(points, depths, poses, camera, 0.1))
    np.testing.assert_array_equal(mask, observed_mask(points, depths[::-1], poses[::-1], camera, 0.1))


def test_observed_mask_of_empty_and_wrong_input():
    camera = Camera(4, 3, 4, 4, 1.5, 1)
    assert observed_mask(np.zeros((0, 3)), [np.ones((3, 4))], [np.eye(4)], camera).shape == (0,)
    assert not observed_mask(np.array([[0, 0, 1.0]]), [], [], camera).any()
    with pytest.raises(ValueError, match=r"observed_mask: depths must have shape \(3, 4\), got \(4, 3\)"):
        observed_mask(np.zeros((1, 3)), [np.ones((4, 3))], [np.eye(4)], camera)
    with pytest.raises(ValueError, match=r"observed_mask: points must have shape \(N, 3\), got \(3,\)"):
        observed_mask(np.zeros(3), [], [], camera)


def test_the_room_against_itself_where_it_was_observed():
    dataset = GeneratedDataset(frames=60, width=80, height=60)
    frames = [dataset[index] for index in range(0, 60, 10)]
    depths, poses = [frame.depth for frame in frames], [frame.pose for frame in frames]
    observed = partial(observed_mask, depths=depths, poses=poses, camera=dataset.camera)
    vertices, faces, _ = dataset.room.mesh(longest_edge_m=0.2)
    metrics = evaluate_surface(TriangleSurface(vertices, faces), dataset.room, observed, 10000)
    assert metrics["f1_1cm"] > 99
    assert metrics["accuracy_cm"] < 0.05
    whole = dataset.room.sample_surface(20000)
    assert 0.1 < observed(whole).mean() < 0.6
    # A point in free space is observed; points outside the view or behind a wall are not.
    inside = dataset.camera.unproject(frames[0].depth)[30, 40] * 0.5
    points = (frames[0].pose @ np.array([[*inside, 1], [0, 0, -1, 1], [*(inside * 3), 1]]).T).T[:, :3]
    assert observed_mask(points, depths[:1], poses[:1], dataset.camera).tolist() == [True, False, False]


def test_observed_samples_of_a_surface_with_a_small_observed_part():
    points = observed_samples(square(), lambda p: p[:, 0] < 0.01, 1000)
    assert 40 < len(points) < 120
    assert (points[:, 0] < 0.01).all()
    assert len(observed_samples(square(), lambda p: p[:, 0] < 0.5, 1000)) == 1000
    empty = TriangleSurface(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert observed_samples(empty, everywhere, 10).shape == (0, 3)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_the_order_of_faces_does_not_matter(order):
    """Of three squares of one size a third is not observed, and of the others one is 10 cm off."""
    exact, off, unseen = square(), square(height=0.1), square(height=9.0)
    meshes = [(exact, off, unseen)[i].triangles() for i in order]
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    faces = np.concatenate([faces + 4 * i for i, (_, faces) in enumerate(meshes)])
    points = observed_samples(TriangleSurface(vertices, faces), lambda p: p[:, 2] < 1, 3000)
    assert len(points) == 3000 and np.mean(points[:, 2] > 0.05) == pytest.approx(0.5, abs=0.03)
