"""Reconstructs an RGB-D sequence with known poses, using only the ops: no tracking, no optimization.

python examples/posed_fusion.py mesh.ply                     the generated room
python examples/posed_fusion.py mesh.ply --data recording    a folder with color/, depth/, intrinsics.txt, poses.txt
python examples/posed_fusion.py mesh.ply --device cuda       on a GPU
"""

import argparse

import torch
import trimesh

from spslam import ops
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.prior import load_prior

VOXEL_M, CUBES = 0.04, 2  # edge of a voxel; marching cubes in each, along an axis
POINTS = 8000  # per frame
MIN_WEIGHT, FULL_WEIGHT, MAX_WEIGHT = 0.006, 2.5, 20.0  # sums of point weights at a vertex; cap of its fused weight


def surface_points(frame, camera, device):
    """World points and unit normals [N, 3] at random pixels of a frame."""
    depth = torch.from_numpy(frame.depth).to(device)
    measured = depth.flatten().nonzero()[:, 0]
    key = 0, ops.RandomStream.ENCODER_POINTS, frame.index, 0
    count = POINTS if len(measured) else 0  # a lens may have been covered
    drawn = measured[ops.sample_indices(*key, count, max(len(measured), 1), device)]
    u, v, z = drawn % camera.width, drawn // camera.width, depth.flatten()[drawn]
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    normals = ops.depth_normals(depth, torch.stack([u, v], 1).int(), *intrinsics, step_px=4, max_jump=0.05)
    points = torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    T_world_camera = torch.from_numpy(frame.pose).float().to(device)
    known, rotation = (normals != 0).any(1), T_world_camera[:3, :3]
    return points[known] @ rotation.T + T_world_camera[:3, 3], normals[known] @ rotation.T


def fuse(frames, camera, prior, device):
    """Encodes the points of every frame and fuses the features at the vertices around them (equation 1)."""
    cells = ops.VoxelHash(device=device)
    embeddings, weights = torch.zeros(0, 8, device=device), torch.zeros(0, device=device)
    for frame in frames:
        if frame.pose is None:  # NaN in the file
            continue
        points, normals = surface_points(frame, camera, device)
        encoded = ops.encode_points(points, normals, prior.encoder_params, VOXEL_M, prior.neighborhood)
        keep = encoded[2] > MIN_WEIGHT
        coords, features, share = (part[keep] for part in encoded)
        ids = cells.insert(coords)
        embeddings = torch.nn.functional.pad(embeddings, (0, 0, 0, len(cells) - len(embeddings)))
        weights = torch.nn.functional.pad(weights, (0, len(cells) - len(weights)))
        ops.fuse_prior_(embeddings, weights, ids, features, (share / FULL_WEIGHT).clamp(max=1), MAX_WEIGHT)
    return cells, embeddings


def extract_mesh(cells, embeddings, prior):
    """Decodes the SDF on a grid in every cell (equation 2) and extracts its zero level set."""
    complete = cells.corner_ids[:, 0] >= 0
    coords, corners = cells.voxel_coords[complete], cells.corner_ids[complete]
    local = torch.cartesian_prod(*[torch.linspace(0, 1, CUBES + 1, device=coords.device)] * 3)
    per_cell = (len(coords), len(local))
    features = ops.trilinear_interpolate(
        embeddings, corners[:, None].expand(*per_cell, 8).reshape(-1, 8), local.expand(*per_cell, 3).reshape(-1, 3)
    )
    positions = VOXEL_M * (coords[:, None] + local).view(-1, 3)
    inputs = torch.cat([0.25 * positions, features], 1)
    sdf = ops.mlp(inputs, prior.decoder_params, hidden=32, output=1, activation=ops.Activation.TANH)
    vertices, faces = ops.marching_cubes(coords, sdf.view(-1, *[CUBES + 1] * 3))
    return VOXEL_M * vertices, faces


def main():
    parser = argparse.ArgumentParser(description="fuse an RGB-D sequence with known poses into a mesh")
    parser.add_argument("mesh", help="file to write, .ply, .obj or .glb")
    parser.add_argument("--data", help="folder with color/, depth/, intrinsics.txt and poses.txt")
    parser.add_argument("--frames", type=int, default=60, help="frames of the generated room")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    args = parser.parse_args()
    config = load_config(
        "folder" if args.data else "demo", overrides=[] if args.data else [f"dataset.frames={args.frames}"]
    )
    dataset, prior = open_dataset(config.dataset, args.data), load_prior().to(torch.device(args.device))
    if dataset.poses() is None:
        parser.error(f"{args.data}: must have poses.txt")
    cells, embeddings = fuse(dataset, dataset.camera, prior, args.device)
    vertices, faces = extract_mesh(cells, embeddings, prior)
    trimesh.Trimesh(vertices.cpu().numpy(), faces.cpu().numpy(), process=False).export(args.mesh)
    print(f"{len(dataset)} frames, {len(cells)} voxels, {len(vertices)} vertices, {len(faces)} faces: {args.mesh}")


if __name__ == "__main__":
    main()
