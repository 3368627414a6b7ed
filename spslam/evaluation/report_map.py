"""The report's pictures: the mesh from above, and views of input and mesh."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from spslam.camera import Camera
from spslam.evaluation import report_images
from spslam.evaluation.html_parts import figure, section
from spslam.evaluation.run_output import Mesh, Preview, RunOutput
from spslam.meshing.render import render_mesh

VIEWS = 3


def outward_mesh(run: RunOutput) -> Mesh | None:
    """The mesh of a run with its front faces towards the observed space; None without mesh or trajectory.

    Raises:
        OutputError: the file is damaged.
    """
    mesh = run.mesh() if len(run.trajectory) else None
    if mesh is None or run.camera is None:
        return mesh
    faces = report_images.outward_faces(mesh, run.camera, run.trajectory.poses[0])
    return Mesh(mesh.vertices, faces, mesh.colors)


def overview_figure(run: RunOutput, mesh: Mesh) -> str:
    """The mesh from above with the trajectory."""
    image = report_images.render_overview(mesh, mesh.faces, run.trajectory.poses)
    caption = "The mesh from above, without the walls nearest to the viewer, and the camera trajectory; "
    caption += f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    return figure(image, 1200, caption, "map")


def views_section(run: RunOutput, mesh: Mesh | None, threads: Executor) -> str:
    """Input images beside the mesh as seen from there, made by these threads; empty without a mesh or a preview."""
    if mesh is None or run.camera is None:
        return ""
    camera = run.camera
    rows = list(threads.map(lambda preview: _view(run, mesh, camera, preview), _spread(run.previews(), VIEWS)))
    return section("Views", "".join(rows), "Input images, and the mesh rendered from the estimated poses")


def _spread(previews: list[Preview], count: int) -> list[Preview]:
    rows = np.unique(np.linspace(0, len(previews) - 1, min(count, len(previews))).round().astype(int))
    return [previews[row] for row in rows]


def _view(run: RunOutput, mesh: Mesh, camera: Camera, preview: Preview) -> str:
    """A row of images: input and rendered color, input depth if it was kept, rendered depth."""
    pose = run.trajectory.poses[preview.row]
    color, depth = render_mesh(mesh.vertices, mesh.faces, mesh.colors, camera, pose, supersampling=2)
    limits = report_images.depth_limits(depth if preview.depth is None else preview.depth)
    images = [
        figure(preview.color, 480, f"frame {preview.row}, input"),
        figure(color, 480, "mesh"),
    ]
    if preview.depth is not None:
        images.append(figure(report_images.colorize_depth(preview.depth, *limits), 480, "input depth"))
    scale = f"mesh depth, yellow {limits[0]:.1f} m to violet {limits[1]:.1f} m"
    images.append(figure(report_images.colorize_depth(depth, *limits), 480, scale))
    return f'<div class="row">{"".join(images)}</div>'
