"""Bundles three.js for the report's 3-D view into one script: python tools/vendor_three.py

Only what the report uses is taken, from the npm packages named below, by esbuild. Needs npm and its registry. Writes
`spslam/evaluation/web/three.min.js` and `three.LICENSE`, which are committed; running it again gives the same bytes.
"""

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

TARGET = Path(__file__).resolve().parent.parent / "spslam" / "evaluation" / "web"
PACKAGES = {"three": "0.187.0", "esbuild": "0.28.2"}
CORE = (
    "AmbientLight BufferAttribute BufferGeometry ColorManagement DirectionalLight DoubleSide FrontSide Group "
    "LinearSRGBColorSpace Matrix4 Mesh MeshLambertMaterial PerspectiveCamera Quaternion Scene Vector2 Vector3 "
    "WebGLRenderer"
)
ADDONS = {
    "OrbitControls": "controls",
    "LineSegments2": "lines",
    "LineSegmentsGeometry": "lines",
    "LineMaterial": "lines",
}
# Browsers with what the report needs besides, `DecompressionStream`, know all of this language level.
LEVEL = "es2022"


def main() -> None:
    """Installs the packages into a temporary folder, and writes the bundle and its license."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "package.json").write_text(json.dumps({"private": True, "dependencies": PACKAGES}))
        subprocess.run(["npm", "install", "--ignore-scripts", "--no-audit", "--no-fund"], cwd=folder, check=True)
        exports = [f'export {{ {", ".join(CORE.split())} }} from "three";']
        exports += [
            f'export {{ {addon} }} from "three/examples/jsm/{place}/{addon}.js";' for addon, place in ADDONS.items()
        ]
        (folder / "entry.js").write_text("\n".join(exports) + "\n")
        output = TARGET / "three.min.js"
        (esbuild,) = (folder / "node_modules" / "@esbuild").glob("*/bin/esbuild")
        options = ["--bundle", "--minify", "--format=iife", "--global-name=THREE", f"--target={LEVEL}"]
        license_file = folder / "node_modules" / "three" / "LICENSE"
        # Every report is a copy of the library, so the script has the whole notice.
        banner = f"--banner:js=/* three.js {PACKAGES['three']}\n\n{license_file.read_text()}*/"
        subprocess.run([esbuild, "entry.js", *options, banner, f"--outfile={output}"], cwd=folder, check=True)
        shutil.copyfile(license_file, TARGET / "three.LICENSE")


if __name__ == "__main__":
    main()
