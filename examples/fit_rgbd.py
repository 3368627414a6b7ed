"""Fits a signed distance field to an RGB-D sequence with known poses, with an eikonal loss: fit_sphere.py on real data.

python examples/fit_rgbd.py room.obj                     the generated room
python examples/fit_rgbd.py room.obj --data recording    a folder with color/, depth/, intrinsics.txt, poses.txt
"""

import argparse

import torch
from fit_sphere import Field, extract_mesh, fit, write_obj

from spslam import ops
from spslam.config import load_config
from spslam.datasets import open_dataset

VOXEL_M = 0.08
PIXELS = 3000  # per frame
STEPS = 400


def surface_points(frame, camera, generator):
    """World points and unit normals [N, 3], towards the camera, at random pixels of a frame."""
    depth = torch.from_numpy(frame.depth)
    measured = depth.flatten().nonzero()[:, 0]
    count = PIXELS if len(measured) else 0  # a lens may have been covered
    drawn = measured[torch.randint(max(len(measured), 1), (count,), generator=generator)]
    u, v, z = drawn % camera.width, drawn // camera.width, depth.flatten()[drawn]
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    normals = ops.depth_normals(depth, torch.stack([u, v], 1).int(), *intrinsics, step_px=4, max_jump=0.05)
    points = torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    T_world_camera = torch.from_numpy(frame.pose).float()
    known, rotation = (normals != 0).any(1), T_world_camera[:3, :3]
    return points[known] @ rotation.T + T_world_camera[:3, 3], normals[known] @ rotation.T


def main():
    parser = argparse.ArgumentParser(description="fit a signed distance field to an RGB-D sequence with known poses")
    parser.add_argument("mesh", help="file to write, .obj")
    parser.add_argument("--data", help="folder with color/, depth/, intrinsics.txt and poses.txt")
    parser.add_argument("--frames", type=int, default=40, help="frames of the generated room")
    parser.add_argument("--steps", type=int, default=STEPS, help="of the optimizer")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    args = parser.parse_args()
    config = load_config(
        "folder" if args.data else "demo", overrides=[] if args.data else [f"dataset.frames={args.frames}"]
    )
    dataset = open_dataset(config.dataset, args.data)
    if dataset.poses() is None:
        parser.error(f"{args.data}: must have poses.txt")
    generator = torch.Generator().manual_seed(0)
    frames = (frame for frame in dataset if frame.pose is not None)  # NaN in the file
    measured = [surface_points(frame, dataset.camera, generator) for frame in frames]
    points, normals = (torch.cat(parts).to(args.device) for parts in zip(*measured, strict=True))
    cells = ops.VoxelHash(device=args.device)
    cells.insert_points(points, VOXEL_M)
    field = Field(cells, VOXEL_M, generator)
    fit(field, points, normals, generator, reach=1.75 * VOXEL_M, steps=args.steps)  # the diagonal of a cell
    vertices, faces = extract_mesh(field)
    write_obj(args.mesh, vertices, faces)
    print(f"{len(measured)} frames, {len(cells)} voxels, {len(vertices)} vertices, {len(faces)} faces: {args.mesh}")


if __name__ == "__main__":
    main()
