"""Point queries of a scene. Not differentiable; `query_sdf_gradient` returns the gradient of the SDF."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import SceneView


@public_op()
def query_sdf(scene: SceneView, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Signed distance at world points, s = F(p, TriLerp(p, V)) (eq. 2).

    Args:
        scene: the map.
        points: float32 [N, 3], m. NaN is outside.

    Returns:
        float32 [N] SDF divided by the truncation, in [-1, 1], 1 outside the complete cells; bool [N], whether inside.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device.

    Example:
        >>> query_sdf(SceneView.empty(), torch.zeros(2, 3))  # nothing is mapped yet
        (tensor([1., 1.]), tensor([False, False]))
    """
    sdf, valid, _ = _query(scene, points, "query_sdf", with_gradient=False)
    return sdf, valid


@public_op()
def query_sdf_gradient(scene: SceneView, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `query_sdf`, with the gradient with respect to the point.

    Args:
        scene: the map.
        points: float32 [N, 3], m. NaN is outside.

    Returns:
        sdf, valid, and float32 [N, 3] d sdf / d point (1/m), 0 outside. N = 0 gives empty tensors.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device.

    Example:
        >>> query_sdf_gradient(SceneView.empty(), torch.zeros(1, 3))[2]
        tensor([[0., 0., 0.]])
    """
    return _query(scene, points, "query_sdf_gradient", with_gradient=True)


@public_op()
def query_color(scene: SceneView, points: torch.Tensor) -> torch.Tensor:
    """RGB at world points, c = F(f_xy + f_xz + f_yz) (eq. 3, 4).

    Args:
        scene: the map; points outside its planes get the color of the border.
        points: float32 [N, 3], m. NaN gives NaN.

    Returns:
        float32 [N, 3] in [0, 1]. The same bits for any number of threads. N = 0 gives an empty tensor.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device.

    Example:
        >>> query_color(SceneView.empty(), torch.zeros(1, 3))  # decoder parameters of 0 give gray
        tensor([[0.5000, 0.5000, 0.5000]])
    """
    scene.check("query_color")
    check_tensor("query_color", "points", points, ("N", 3), torch.float32, like=scene.embeddings)
    return torch.ops.spslam.query_color(*scene.arguments(), points)


def _query(
    scene: SceneView, points: torch.Tensor, function: str, with_gradient: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    scene.check(function)
    check_tensor(function, "points", points, ("N", 3), torch.float32, like=scene.embeddings)
    return torch.ops.spslam.query_sdf(*scene.arguments(), points, with_gradient)


@torch.library.register_fake("spslam::query_sdf")
def _(scene, scene_scalars, plane_layout, points, with_gradient):
    n = points.shape[0]
    return (
        points.new_empty(n),
        points.new_empty(n, dtype=torch.bool),
        points.new_empty((n if with_gradient else 0, 3)),
    )


@torch.library.register_fake("spslam::query_color")
def _(scene, scene_scalars, plane_layout, points):
    return points.new_empty((points.shape[0], 3))
