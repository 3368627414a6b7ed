"""Surfaces sampled from their parametric forms: an independent reference for the signed distances."""

import math

import torch

FACES = 120


def grid(first, second):
    u, v = torch.meshgrid(torch.linspace(*first, FACES), torch.linspace(*second, FACES), indexing="ij")
    return u.reshape(-1).double(), v.reshape(-1).double()


def plane(reach=6.0):
    u, v = grid((-reach, reach), (-reach, reach))
    return torch.stack([u, v, torch.zeros_like(u)], 1)


def sphere(radius):
    azimuth, polar = grid((0, 2 * math.pi), (0, math.pi))
    return radius * torch.stack([azimuth.cos() * polar.sin(), azimuth.sin() * polar.sin(), polar.cos()], 1)


def cylinder(radius, reach=6.0):
    azimuth, height = grid((0, 2 * math.pi), (-reach, reach))
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), height], 1)


def box(half_size):
    u, v = grid((-1, 1), (-1, 1))
    half_size = torch.tensor(half_size, dtype=torch.float64)
    faces = [torch.stack([side * torch.ones_like(u), u, v], 1).roll(axis, 1) for axis in range(3) for side in (-1, 1)]
    return torch.cat(faces) * half_size


def torus(radius, tube_radius):
    azimuth, tube = grid((0, 2 * math.pi), (0, 2 * math.pi))
    ring = radius + tube_radius * tube.cos()
    return torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), tube_radius * tube.sin()], 1)


def superquadric(half_size, exponent):
    # Directions through a grid on the faces of a box are more uniform at the edges than a grid of angles.
    directions = box((1.0, 1.0, 1.0)) * torch.tensor(half_size, dtype=torch.float64)
    scaled = directions.abs() / torch.tensor(half_size, dtype=torch.float64)
    return directions / scaled.pow(exponent).sum(1, keepdim=True).pow(1 / exponent)


def wavy_sheet(amplitude, wave_number, reach=6.0):
    u, v = grid((-reach, reach), (-reach, reach))
    return torch.stack([u, v, amplitude * ((wave_number * u).sin() + (wave_number * v).sin())], 1)


def nearest_distance(points, surface):
    """Distance of each point [N, 3] to the nearest sample of the surface."""
    return torch.cat([torch.cdist(chunk, surface).amin(1) for chunk in points.split(64)])
