"""Simulated depth observations of random solids: noisy points with normals, and queries with exact distances.

All lengths are in voxels. A patch is a window of six by six voxels, observed along parallel rays.
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
    """Settings of the simulated observations.

    Attributes:
        rays: rays per patch; each gives a query and, unless dropped, a point.
        truncation: queries are drawn within this distance of the surface, in voxels.
        noise: standard deviation of the noise along the view ray, in voxels; None draws one per patch.
        max_noise: largest standard deviation drawn; small ones are drawn more often.
        max_normal_blur: largest step of the finite differences for normals, drawn per patch, in voxels; as in a depth
            image, normals then change gradually at an edge.
        max_normal_jitter: largest standard deviation of the noise on each component of the normals, drawn per patch.
    """

    rays: int = 128
    truncation: float = 2.0
    noise: float | None = None
    max_noise: float = 0.3
    max_normal_blur: float = 0.0
    max_normal_jitter: float = 0.2


@dataclass(frozen=True)
class Patches:
    """B observed patches, each in its own grid of vertices at integer coordinates.

    Attributes:
        points: [B, N, 3], input of the encoder; 0 where `seen` is false.
        normals: [B, N, 3], input of the encoder; 0 where `seen` is false.
        seen: bool [B, N], which rays give a point.
        queries: [B, N, 3], points near the surface; 0 where `valid` is false.
        sdf: [B, N], exact signed distance of the queries / truncation, in [-1, 1].
        valid: bool [B, N], which queries can be used.
        surface: [B, N, 3], where the rays meet the surface.
        surface_normals: [B, N, 3], exact normals there.
        view: [B, 1, 3], direction of the rays.
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
        """Concatenates batches."""
        return Patches(*(torch.cat([getattr(batch, f.name) for batch in batches]) for f in fields(Patches)))

    def __getitem__(self, rows: slice | Tensor) -> Patches:
        """A subset of the patches."""
        return Patches(*(getattr(self, f.name)[rows] for f in fields(Patches)))

    def __len__(self) -> int:
        return len(self.seen)


def observe(kind: str, count: int, generator: Generator, settings: PatchSettings) -> Patches:
    """Draws `count` solids of a kind and observes each from one random direction.

    A query is valid if its ray reached the surface, its distance is exact, its sign is the one that the ray observes,
    and the surface nearest to it faces the camera, because a view cannot observe the far side of a thin wall.

    Args:
        kind: see `spslam.prior.shapes.random_solid`.
        count: number of solids.
        generator: the only source of randomness; the same state gives the same patches.
        settings: of the observation.
    """
    solid = _at_origin(random_solid(kind, count, generator), count, generator)
    view = _view_directions(solid, count, generator)
    window, surface, facing, reached = _trace(solid, view, settings.rays, generator)
    seen = reached & _random_dropout(window, generator)
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
class _Translated(Solid):
    """A solid relative to another origin [B, 1, 3]."""

    solid: Solid
    origin: Tensor

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.solid.signed_distance(points + self.origin)

    def march_distance(self, points: Tensor) -> Tensor:
        return self.solid.march_distance(points + self.origin)

    def normals(self, points: Tensor, step: float | Tensor = FINE_STEP) -> Tensor:
        return self.solid.normals(points + self.origin, step)


def _at_origin(solid: Solid, count: int, generator: Generator) -> Solid:
    """Translates each solid so that a point of its surface is at a random position in the voxel around the origin."""
    anchor = nearest_surface(solid, 0.7 * torch.randn(count, 1, 3, generator=generator))
    return _Translated(solid, anchor + torch.rand(count, 1, 3, generator=generator) - 0.5)


def _view_directions(solid: Solid, count: int, generator: Generator) -> Tensor:
    """View directions [B, 1, 3], within about 80 degrees of the inverse surface normal at the origin."""
    normal = solid.normals(torch.zeros(count, 1, 3))
    spread = torch.randn(count, 1, 3, generator=generator).clamp(-2, 2)
    view = normalize(0.55 * spread - normal, dim=-1)
    grazing = (view * normal).sum(-1, keepdim=True) > -0.15
    return (-normal).where(grazing, view)


def _trace(solid: Solid, view: Tensor, rays: int, generator: Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sphere-traces parallel rays through random positions in the window.

    Returns:
        Positions in the window [B, R, 2], points reached [B, R, 3], normals there [B, R, 3], and bool [B, R], whether
        the point is on the surface, observed from outside, and well inside the grid.
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


def _random_dropout(window: Tensor, generator: Generator) -> Tensor:
    """Which rays to keep, bool [B, R]: a share drawn per patch, without a round hole in 30 % of the patches."""
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
    """Points with noise along the rays, and unit normals with blur and noise."""
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
    """Queries in front of and behind the surface along the rays, half of them close to it; distances and validity."""
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
