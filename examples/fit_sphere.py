"""Fits a signed distance field to points on a sphere, with an eikonal loss, using only the ops and torch.

python examples/fit_sphere.py                  prints how far the surface is from the sphere
python examples/fit_sphere.py --mesh ball.obj  also writes the mesh
python examples/fit_sphere.py --device cuda    on a GPU
"""

import argparse

import torch

from spslam import ops

RADIUS_M, VOXEL_M = 0.5, 0.05
FEATURES, HIDDEN = 8, 32
STEPS, BATCH = 200, 4096


def surface_points(count, generator):
    """Points and outward normals [N, 3] on the sphere: what a depth camera would have measured."""
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return RADIUS_M * normals, normals


class Field(torch.nn.Module):
    """Signed distance, meters: features at the voxels around the surface, interpolated and decoded."""

    def __init__(self, cells, voxel_size, generator):
        super().__init__()
        self.cells, self.voxel_size = cells, voxel_size
        features = 0.01 * torch.randn(len(cells), FEATURES, generator=generator)
        self.features = torch.nn.Parameter(features.to(cells.voxel_coords.device))
        decoder = ops.mlp_init_params(FEATURES, HIDDEN, 1, generator=generator)
        self.decoder = torch.nn.Parameter(decoder.to(cells.voxel_coords.device))

    def forward(self, points):
        corner_ids, local = self.cells.lookup(points, self.voxel_size)
        inside = corner_ids[:, 0] >= 0  # points in cells that were not allocated have no value
        features = ops.trilinear_interpolate(self.features, corner_ids, local)
        return self.voxel_size * ops.mlp(features, self.decoder, HIDDEN, 1)[:, 0], inside


def fit(field, points, normals, generator, reach, steps=STEPS):
    """Distances along the normals, up to `reach` meters, are known; the length of the gradient is 1 everywhere."""
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        drawn = torch.randint(len(points), (BATCH,), generator=generator)
        distance = (reach * (2 * torch.rand(BATCH, generator=generator) - 1)).to(points.device)
        where = (points[drawn] + distance[:, None] * normals[drawn]).requires_grad_()
        sdf, inside = field(where)
        (slope,) = torch.autograd.grad(sdf.sum(), where, create_graph=True)
        data = (sdf - distance)[inside].abs().mean() / field.voxel_size
        eikonal = (slope[inside].norm(dim=1) - 1).square().mean()
        optimizer.zero_grad()
        (data + 0.01 * eikonal).backward()
        optimizer.step()
        schedule.step()


@torch.no_grad()
def extract_mesh(field, cubes=2):
    """Vertices and faces of the zero level set, by marching cubes in every complete cell."""
    cells = field.cells
    coords = cells.voxel_coords[cells.corner_ids[:, 0] >= 0]
    steps = torch.linspace(0.0, 1.0, cubes + 1, device=coords.device)
    local = torch.cartesian_prod(steps, steps, steps)
    # Just inside of the cell, as the far side of it belongs to the next one.
    points = field.voxel_size * (coords[:, None] + local.clamp(1e-3, 1 - 1e-3)).view(-1, 3)
    sdf, _ = field(points)
    vertices, faces = ops.marching_cubes(coords, sdf.view(-1, cubes + 1, cubes + 1, cubes + 1))
    return field.voxel_size * vertices, faces


def fitted_sphere(device="cpu"):
    """The field of the sphere."""
    generator = torch.Generator().manual_seed(0)
    points, normals = (part.to(device) for part in surface_points(20_000, generator))
    cells = ops.VoxelHash(device=device)
    cells.insert_points(points, VOXEL_M, band=VOXEL_M)
    field = Field(cells, VOXEL_M, generator)
    # The far corners of the cells within a voxel of a point are 2 sqrt(3) voxels away from it.
    fit(field, points, normals, generator, reach=4 * VOXEL_M)
    return field


def write_obj(path, vertices, faces):
    with open(path, "w") as file:
        file.writelines(f"v {x} {y} {z}\n" for x, y, z in vertices.tolist())
        file.writelines(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces.tolist())


def main():
    parser = argparse.ArgumentParser(description="fit a signed distance field to a sphere")
    parser.add_argument("--mesh", help="file to write, .obj")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    args = parser.parse_args()
    field = fitted_sphere(args.device)
    vertices, faces = extract_mesh(field)
    error = (vertices.norm(dim=1) - RADIUS_M).abs()
    share, median_mm = (error < 0.01).float().mean().item(), 1000 * error.median().item()
    size = f"{len(field.cells)} voxels, {len(vertices)} vertices"
    print(f"{size}, {100 * share:.1f} % within 1 cm, median {median_mm:.2f} mm")
    if args.mesh:
        write_obj(args.mesh, vertices, faces)


if __name__ == "__main__":
    main()
