"""Colors of fused meshes at views that were held out: of vertices and of textures, beside Open3D's fusion.

    python -m experiments.mesh_colors RUN [RUN ...] --every 8 --voxels 0.01 0.005 --subdivisions 0 2

Of the tracked frames of a finished run every so many-th is held out; the others are fused at the run's poses, without
the map's filling, by Open3D with the first size of voxels and by spslam with each: with the voxels' colors, with the
frames' at vertices (a run writes those of edges divided twice) and with a texture. All meshes are rendered at the poses
of the frames held out and compared with the images over the pixels that all of them show: PSNR in dB, mean over the
views, and SSIM; PSNR over those of them where all have the frame's depth to 3 cm, as elsewhere the surface is wrong,
not its color; and PSNR ("corrected") after the mesh's image was given another gain per channel and moved by an affine
warp so that it agrees best with the frame, each mesh by its own: what a camera with automatic exposure, or whose color
is late, does to the image held out is no error of a mesh. Coverage is the share of all pixels that a mesh shows. Of
Open3D's weight thresholds the one with the better PSNR counts. Needs `pip install 'spslam[open3d]'`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from experiments.arguments import make_parser
from experiments.tsdf_baseline import fuse
from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdFrame
from spslam.evaluation.image_metrics import psnr_db, ssim
from spslam.evaluation.run_output import RunOutput
from spslam.geometry import transform_points
from spslam.meshing import TriangleMesh
from spslam.meshing.color_detail import ColorOptions, color_mesh
from spslam.meshing.depth_views import DepthViews
from spslam.meshing.frame_fusion import FusionOptions, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.meshing.render import rasterize, render_colors
from spslam.meshing.shading import cross
from spslam.meshing.texture import TexturedMesh, TextureOptions, texture_mesh
from spslam.meshing.texture.registration import register
from spslam.meshing.texture.views import ColorView
from spslam.ops.depth_planes import DEFAULT_NOISE
from spslam.run.mesh import measured_noise, posed_frames
from spslam.trajectory import Trajectory

MOST_VIEWS, MEMORY_MB = 40, 4000
SAME_M = 0.03
FIGURES = ("psnr_db", "ssim", "same_db", "corrected_db", "coverage")
_EVERY_PX = 3  # of the pixels that a view is registered by


def main() -> None:
    """Parses the arguments; prints a table per run."""
    args = _parser().parse_args()
    for folder in args.runs:
        run = RunOutput.read(folder)
        views, figures = measure(run, args)
        print(f"\n{folder.name}, {views} views\n")
        print(
            "| mesh | PSNR dB | SSIM | PSNR of the same surface | corrected PSNR | coverage % |\n"
            "|---|---|---|---|---|---|"
        )
        for name, row in figures.items():
            print(f"| {name} | {' | '.join(f'{row[figure]:.2f}' for figure in FIGURES)} |", flush=True)


def measure(run: RunOutput, args: argparse.Namespace) -> tuple[int, dict[str, dict[str, float]]]:
    """The number of views, and the figures of each mesh at them."""
    dataset = open_dataset(load_config(run.folder.config).dataset)
    fused, held = split(run.trajectory, args.every)
    frames = posed_frames(dataset, fused)
    noise = measured_noise(run.metrics) or DEFAULT_NOISE
    meshes: dict[str, TriangleMesh | TexturedMesh] = {}
    for threshold, mesh in enumerate(
        [] if args.no_open3d else fuse(dataset, replace(run, trajectory=fused), args.voxels[0])
    ):
        meshes[f"Open3D {1e3 * args.voxels[0]:g} mm, weights {threshold}"] = mesh
    for voxel in args.voxels:
        shown = DepthViews([frames], [noise])
        volume = fuse_frames(frames, FusionOptions(voxel, MEMORY_MB, noise), views=shown)
        mesh = extract_fused_mesh(volume, views=shown)
        size = f"{1e3 * voxel:g} mm"
        meshes[f"voxels {size}"] = mesh
        for number in args.subdivisions:
            started = time.perf_counter()
            colored, used = color_mesh(mesh, frames, ColorOptions(noise, number))
            print(f"{colored} of {used} frames in {time.perf_counter() - started:.0f} s, before {mesh}", flush=True)
            meshes[f"vertices {size}, divided {number} times"] = colored
        if not args.no_texture:
            started = time.perf_counter()
            textured = texture_mesh(mesh, frames, TextureOptions(noise, args.texel))
            print(f"{textured} of {len(frames)} frames in {time.perf_counter() - started:.0f} s", flush=True)
            meshes[f"texture {size}"] = textured
    unseen = posed_frames(dataset, held)
    views = [(frame, unseen.poses[position]) for position, frame in unseen.read()]
    views = views[:: max(-(-len(views) // MOST_VIEWS), 1)]
    if args.save:
        for name, each in meshes.items():
            each.save(args.save / f"{run.folder.path.name}-{name.replace(' ', '-').replace(',', '')}.glb")
    figures = dict(zip(meshes, compare(list(meshes.values()), views, dataset.camera), strict=True))
    others = sorted((name for name in figures if name.startswith("Open3D")), key=lambda name: figures[name]["psnr_db"])
    for name in others[:-1]:
        del figures[name]
    return len(views), figures


def split(trajectory: Trajectory, every: int) -> tuple[Trajectory, Trajectory]:
    """The trajectory of the frames to be fused and of those held out; what is not in one of them is lost there.

    Args:
        trajectory: of a run.
        every: of its tracked frames each so many-th is held out, from the middle of the first so many on.
    """
    tracked = np.flatnonzero(~trajectory.lost)
    out = np.zeros(len(trajectory), dtype=bool)
    out[tracked[every // 2 :: every]] = True
    return replace(trajectory, lost=trajectory.lost | out), replace(trajectory, lost=~out)


def compare(
    meshes: Sequence[TriangleMesh | TexturedMesh],
    views: Sequence[tuple[RgbdFrame, np.ndarray]],
    camera: Camera,
) -> list[dict[str, float]]:
    """`FIGURES` of each mesh, means over the views; all but coverage over the pixels that all of them show."""
    figures: list[list[tuple[float, ...]]] = [[] for _ in meshes]
    for frame, pose in views:
        images = [_rendered(each, camera, pose) for each in meshes]
        shown = np.all([depth > 0 for _, depth in images], axis=0)
        same = shown & np.all([np.abs(depth - frame.depth) < SAME_M for _, depth in images], axis=0)
        for rows, (color, depth) in zip(figures, images, strict=True):
            ratios = psnr_db(color, frame.color, shown), psnr_db(color, frame.color, same)
            corrected = _corrected_db(color, frame, camera, shown)
            covered = 100 * float(np.mean(depth > 0))
            rows.append((ratios[0], ssim(color, frame.color, shown), ratios[1], corrected, covered))
    return [{name: _mean([row[i] for row in rows]) for i, name in enumerate(FIGURES)} for rows in figures]


def _rendered(mesh: TriangleMesh | TexturedMesh, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colors uint8 [H, W, 3] and depth float32 [H, W] of a mesh, without light."""
    if isinstance(mesh, TriangleMesh):
        return render_colors(mesh.vertices, mesh.faces, mesh.colors, camera, pose)
    raster = rasterize(mesh.vertices, mesh.faces, camera, pose)
    hit = raster.face_ids >= 0
    faces = raster.face_ids[hit]
    points = transform_points(np.linalg.inv(pose), mesh.vertices.astype(np.float64)).astype(np.float32)
    corners = points[mesh.faces[faces]]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = _barycentric(corners, (camera.ray_directions() * raster.depth[..., None])[hit], normals)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    image[hit] = np.rint(mesh.colors_at(faces, weights))
    return image, raster.depth


def _barycentric(corners: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Barycentric weights [N, 3] of points in the planes of triangles."""
    area = np.maximum(_dot(normals, normals), 1e-30)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    wb = _dot(cross(points - a, c - a), normals) / area
    wc = _dot(cross(b - a, points - a), normals) / area
    weights = [np.clip(weight, 0, 1) for weight in (1 - wb - wc, wb, wc)]
    total = np.maximum(weights[0] + weights[1] + weights[2], 1e-12)
    return np.stack([weight / total for weight in weights], axis=1).astype(np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products [N] of vectors [N, 3]; a sum over so short an axis takes NumPy several times as long."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _corrected_db(color: np.ndarray, frame: RgbdFrame, camera: Camera, shown: np.ndarray) -> float:
    """PSNR after a gain per channel and an affine warp of the mesh's image."""
    v, u = np.nonzero(shown[::_EVERY_PX, ::_EVERY_PX])
    places = np.stack([_EVERY_PX * u, _EVERY_PX * v, np.ones_like(u)], axis=1).astype(np.float32)
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[::_EVERY_PX, ::_EVERY_PX][v, u].astype(np.float32)
    view = ColorView(0, frame, camera, np.eye(4), DEFAULT_NOISE)
    warp = register(view, places, gray, np.eye(3))
    # The mesh's image is moved, not the frame's: interpolation would take noise and edges from what is compared with.
    size, motion = (camera.width, camera.height), np.linalg.inv(warp)[:2]
    moved = cv2.warpAffine(color, motion, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    counted = cv2.warpAffine(shown.astype(np.float32), motion, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP) == 1
    wanted, given = frame.color[counted].astype(np.float64), moved[counted].astype(np.float64)
    gains = (wanted * given).sum(0) / np.maximum((given**2).sum(0), 1)
    return psnr_db(np.clip(np.rint(moved * gains), 0, 255).astype(np.uint8), frame.color, counted)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="output folder of a finished run")
    parser.add_argument("--every", type=int, default=8, help="of so many tracked frames one is held out")
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.01], help="m; Open3D has the first")
    parser.add_argument("--texel", type=float, help="m; as finely as the frames saw if not given")
    parser.add_argument("--no-open3d", action="store_true", help="leave Open3D out")
    parser.add_argument("--no-texture", action="store_true", help="leave textures out")
    parser.add_argument("--subdivisions", type=int, nargs="*", default=[2], help="of edges, for colors of vertices")
    parser.add_argument("--save", type=Path, help="folder for the meshes, as .glb")
    return parser


if __name__ == "__main__":
    main()
