"""What a depth camera would see of random solids: noisy points with normals, and queries with their true distance.

All lengths are in voxels. A patch is a window of six voxels a side, seen along parallel rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Generator, Tensor
from torch.nn.functional import normalize

from spslam.prior.shapes import FINE_STEP, Solid, nearest_surface, random_solid

_WINDOW = 6.0
_REACH = 4.0
_MARCH_START = 6.0
_MARCH_STEPS = 24
_ON_SURFACE = 0.02


@dataclass(frozen=True)
class PatchSettings:
    """How patches are observed.

    Attributes
    ----------
    rays : rays a patch, each of which gives a query and, unless thinned out, a point.
    truncation : half width of the band that queries are drawn from, in voxels.
    noise : standard deviation along the view ray; None draws one for each patch up to ``max_noise``, small ones more
        often.
    max_normal_blur : reach of the differences that normals are measured over, drawn for each patch up to this; a depth
        image's normals turn gradually at an edge.
    max_normal_jitter : standard deviation of each component of the normals, drawn for each patch up to this.
    """

    rays: int = 128
    truncation: float = 2.0
    noise: float | None = None
    max_noise: float = 0.3
    max_normal_blur: float = 0.0
    max_normal_jitter: float = 0.2


@dataclass(frozen=True)
class Patches:
    """B observed patches; a vertex lattice of whole numbers goes with each.

    Attributes
    ----------
    points, normals : [B,N,3] what the encoder is given, 0 where ``seen`` [B,N] is False.
    queries : [B,N,3] places in the band about the surface, 0 where ``valid`` [B,N] is False.
    sdf : [B,N] true Euclidean signed distance there over the truncation, in [-1, 1].
    surface, surface_normals : [B,N,3] where the rays meet the surface, and the true normals there.
    view : [B,1,3] direction of the rays.
    """

    points: Tensor
    normals: Tensor
    seen: Tensor
    queries: Tensor
    sdf: Tensor
    valid: Tensor
    surface: Tensor
    surface_normals: Tensor
    view: Tensor

    @staticmethod
    def cat(batches: Sequence[Patches]) -> Patches:
        """Several batches as one."""
        return Patches(*(torch.cat([getattr(batch, f.name) for batch in batches]) for f in fields(Patches)))

    def __getitem__(self, rows: slice | Tensor) -> Patches:
        """Some of the patches."""
        return Patches(*(getattr(self, f.name)[rows] for f in fields(Patches)))

    def __len__(self) -> int:
        return len(self.seen)


def observe(kind: str, count: int, generator: Generator, settings: PatchSettings) -> Patches:
    """Draw ``count`` solids of a kind and look at each from one random side.

    A query is valid if its ray reached the surface, its distance is exact, its sign is the one that the ray sees, and
    its nearest surface faces the camera: the far side of a thin wall is nothing that the view could tell.
    Deterministic: every draw comes from ``generator``.
    """
    solid = _about_the_origin(random_solid(kind, count, generator), count, generator)
    view = _view_directions(solid, count, generator)
    window, surface, facing, reached = _trace(solid, view, settings.rays, generator)
    seen = reached & _survives(window, generator)
    points, normals = _measure(solid, surface, view, generator, settings)
    queries, distance, valid = _query(solid, surface, view, generator, settings)
    valid = valid & reached
    return Patches(
        points=points.where(seen[..., None], 0.0),
        normals=normals.where(seen[..., None], 0.0),
        seen=seen,
        queries=queries.where(valid[..., None], 0.0),
        sdf=(distance / settings.truncation).clamp(-1, 1),
        valid=valid,
        surface=surface,
        surface_normals=facing,
        view=view,
    )


@dataclass(frozen=True)
class _Moved(Solid):
    """A solid seen from another origin [B,1,3]."""

    solid: Solid
    origin: Tensor

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.solid.signed_distance(points + self.origin)

    def march_distance(self, points: Tensor) -> Tensor:
        return self.solid.march_distance(points + self.origin)

    def normals(self, points: Tensor, step: float | Tensor = FINE_STEP) -> Tensor:
        return self.solid.normals(points + self.origin, step)


def _about_the_origin(solid: Solid, count: int, generator: Generator) -> Solid:
    """Move a piece of surface to a random place of the voxel about the origin."""
    anchor = nearest_surface(solid, 0.7 * torch.randn(count, 1, 3, generator=generator))
    return _Moved(solid, anchor + torch.rand(count, 1, 3, generator=generator) - 0.5)


def _view_directions(solid: Solid, count: int, generator: Generator) -> Tensor:
    """Directions [B,1,3] into the scene, within about 80 degrees of the surface's normal at the origin."""
    normal = solid.normals(torch.zeros(count, 1, 3))
    spread = torch.randn(count, 1, 3, generator=generator).clamp(-2, 2)
    view = normalize(0.55 * spread - normal, dim=-1)
    grazing = (view * normal).sum(-1, keepdim=True) > -0.15
    return (-normal).where(grazing, view)


def _trace(solid: Solid, view: Tensor, rays: int, generator: Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sphere-trace parallel rays through random places of the window.

    Returns the places in the window [B,R,2], the points reached [B,R,3], the normals there, and which points are
    surface seen from outside, well inside the lattice.
    """
    count = view.shape[0]
    window = _WINDOW * (torch.rand(count, rays, 2, generator=generator) - 0.5)
    up = normalize(torch.cross(view, torch.randn(count, 1, 3, generator=generator), dim=-1), dim=-1)
    right = torch.cross(view, up, dim=-1)
    start = window[..., :1] * up + window[..., 1:] * right - _MARCH_START * view
    distance = solid.signed_distance(start)
    outside, depth = distance > 0, 0.9 * distance
    for _ in range(_MARCH_STEPS):
        depth = depth + 0.9 * solid.march_distance(start + depth[..., None] * view)
    surface = start + depth[..., None] * view
    on_surface = (solid.signed_distance(surface).abs() < _ON_SURFACE) & (surface.abs().amax(-1) < _REACH)
    normals = solid.normals(surface)
    faces_camera = (normals * view).sum(-1) < -0.1
    return window, surface, normals, outside & on_surface & faces_camera & (depth > 0)


def _survives(window: Tensor, generator: Generator) -> Tensor:
    """A share of the pixels, drawn for each patch, outside a round hole that every third patch has."""
    count, pixels = window.shape[:2]
    has_hole = torch.rand(count, 1, generator=generator) < 0.3
    radius = (1.5 * torch.rand(count, 1, generator=generator)).where(has_hole, 0.0)
    hole = 4 * (torch.rand(count, 1, 2, generator=generator) - 0.5)
    share = 0.15 + 0.85 * torch.rand(count, 1, generator=generator)
    kept = torch.rand(count, pixels, generator=generator) < share
    return kept & ((window - hole).norm(dim=-1) > radius)


def _measure(
    solid: Solid, surface: Tensor, view: Tensor, generator: Generator, settings: PatchSettings
) -> tuple[Tensor, Tensor]:
    """Points with noise along the rays, and blurred, jittered unit normals."""
    count, pixels = surface.shape[:2]
    noise = torch.rand(count, 1, generator=generator).square() * settings.max_noise
    if settings.noise is not None:
        noise = torch.full((count, 1), settings.noise)
    error = noise * torch.randn(count, pixels, generator=generator)
    jitter = settings.max_normal_jitter * torch.rand(count, 1, 1, generator=generator)
    jitter = jitter * torch.randn(count, pixels, 3, generator=generator)
    blur = (settings.max_normal_blur * torch.rand(count, 1, 1, generator=generator)).clamp_min(FINE_STEP)
    return surface + error[..., None] * view, normalize(solid.normals(surface, blur) + jitter, dim=-1)


def _query(
    solid: Solid, surface: Tensor, view: Tensor, generator: Generator, settings: PatchSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Places before and behind the surface along the rays, half of them close to it, with distance and validity."""
    count, rays = surface.shape[:2]
    band = 2 * torch.rand(count, rays, generator=generator) - 1
    close = torch.arange(rays) % 2 == 0
    behind = settings.truncation * (band.pow(3)).where(close, band)
    queries = surface + behind[..., None] * view
    distance, normals = solid.signed_distance(queries), solid.normals(queries)
    foot = queries - distance[..., None] * normals
    exact = solid.signed_distance(foot).abs() < _ON_SURFACE
    sees_sign = (distance.sign() == -behind.sign()) | (behind.abs() < 0.05)
    faces_camera = (normals * view).sum(-1) < 0
    return queries, distance, exact & sees_sign & faces_camera
