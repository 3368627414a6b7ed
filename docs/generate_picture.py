"""Writes the README's picture from a finished demo: ``python docs/generate_picture.py runs/demo``."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from spslam.evaluation import report_images  # noqa: E402
from spslam.evaluation.run_output import RunOutput  # noqa: E402
from spslam.meshing.render import render_mesh  # noqa: E402

HEIGHT, GAP = 600, 12


def main(output: Path) -> None:
    """Write docs/images/demo.jpg: the map from above with the path; an input frame over the mesh seen from there."""
    run = RunOutput.read(output)
    mesh, preview = run.mesh(), run.previews()[0]
    if mesh is None or run.camera is None:
        raise SystemExit(f"{output}: has no mesh or no previews")
    poses = run.trajectory.poses
    above = report_images.render_overview(mesh, report_images.outward_faces(mesh, run.camera, poses[0]), poses)
    seen, _ = render_mesh(mesh.vertices, mesh.faces, mesh.colors, run.camera, poses[preview.row], supersampling=2)
    half = (HEIGHT - GAP) // 2
    column = np.concatenate([_tall(preview.color, half), _white(GAP, _tall(seen, half).shape[1]), _tall(seen, half)])
    picture = np.concatenate([_tall(above, HEIGHT), _white(HEIGHT, GAP), _tall(column, HEIGHT)], axis=1)
    path = ROOT / "docs" / "images" / "demo.jpg"
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def _tall(image: np.ndarray, height: int) -> np.ndarray:
    width = round(image.shape[1] * height / image.shape[0])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _white(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 255, np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
