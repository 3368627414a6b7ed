"""What must hold for an installed spslam: run by a fresh environment's Python, beside nothing but what pip installed.

python tools/check_installed.py [--short]
"""

import doctest
import os
import pkgutil
import re
import subprocess
import sys
import tempfile
from importlib.metadata import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ISAS = {"AVX512": ("baseline", "avx2", "avx512"), "AVX2": ("baseline", "avx2")}
DRAW = "from spslam import ops; print(ops.CPU_ISA, ops.philox_uniform(0, 0, 0, 0, 3).tolist())"
# Color that another camera took, by the library of plain functions that reading uses.
REGISTER = """
import numpy as np
from spslam.camera import Camera
from spslam.datasets.registration import ColorToDepth

camera, place = Camera(8, 6, 9.0, 9.0, 3.5, 2.5), np.eye(4)
place[0, 3] = 0.02
colors, depth = ColorToDepth(camera, camera, place)(np.full((6, 8, 3), 9, np.uint8), np.ones((6, 8), np.float32))
assert (colors == 9).all() and depth.any()
"""


def spslam(*arguments: str) -> str:
    """The command that was installed beside this Python."""
    return run(str(Path(sys.executable).parent / "spslam"), *arguments)


def python(*arguments: str, **environment: str) -> str:
    return run(sys.executable, *arguments, **environment)


def run(*command: str, **environment: str) -> str:
    finished = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
    if finished.returncode:
        sys.exit(f"check: {' '.join(command)} failed:\n{finished.stdout}{finished.stderr}")
    return finished.stdout


def check_it_is_the_installed_one() -> None:
    import spslam

    if (
        ROOT in Path(spslam.__file__).resolve().parents
        and ROOT / "build" not in Path(spslam.__file__).resolve().parents
    ):
        sys.exit(f"check: spslam must be the installed one, got {spslam.__file__}")


def check_metadata() -> None:
    """What a package index shows: links of the description must not be relative."""
    found = metadata("spslam")
    links = re.findall(r"\]\(([^)]+)\)", found.get_payload())
    relative = [link for link in links if not re.match(r"https?:|mailto:|#", link)]
    if not links or relative:
        sys.exit(f"check: links of the description must be absolute, got {relative or 'none'}")
    print(f"{len(links)} links of the description are absolute; {', '.join(found.get_all('Project-URL'))}")


def check_doctor() -> None:
    """The kernels work, and where CUDA is off it says why."""
    text = spslam("doctor")
    print(text)
    if "working" not in text or not re.search(r"CUDA kernels +(working|off: \w+)", text):
        sys.exit("check: doctor must find working kernels")


def check_instruction_sets() -> None:
    """The same draws and colors from every library that this processor can run."""
    import torch

    import spslam

    folder = Path(spslam.__file__).parent
    for isa in ISAS.get(torch.backends.cpu.get_cpu_capability(), ("baseline",)):
        if isa == "baseline" or (folder / f"_ops_cpu_{isa}.so").exists():
            print(python("-c", DRAW, SPSLAM_CPU_ISA=isa), end="")
            python("-c", REGISTER, SPSLAM_CPU_ISA=isa)


def check_examples() -> None:
    """Docstrings and pages of the ops, as written."""
    import torch

    from spslam import ops

    names = {name: getattr(ops, name) for name in ops.__all__} | {"torch": torch}
    attempted = 0
    for module in pkgutil.iter_modules(ops.__path__, "spslam.ops."):
        result = doctest.testmod(__import__(module.name, fromlist=["x"]), extraglobs=names)
        attempted += result.attempted
        if result.failed:
            sys.exit(f"check: examples of {module.name} failed")
    for page in sorted((ROOT / "docs" / "ops").glob("*.md")):
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        test = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, page.name, str(page), 0)
        result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test)
        attempted += result.attempted
        if result.failed:
            sys.exit(f"check: examples of {page.name} failed")
    print(f"{attempted} examples run")


def check_demo(frames: int) -> None:
    """From images to a mesh and a report."""
    from spslam.run_folder import RunFolder

    folder = RunFolder(Path("out"))
    print(spslam("demo", "--frames", str(frames), "--output", str(folder.path)))
    missing = [
        path
        for path in (folder.trajectory, folder.map, folder.mesh, folder.metrics, folder.report)
        if not path.exists()
    ]
    if missing:
        sys.exit(f"check: demo must leave {missing[0]}")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        check_it_is_the_installed_one()
        check_metadata()
        check_doctor()
        check_instruction_sets()
        check_examples()
        check_demo(8 if "--short" in sys.argv else 40)


if __name__ == "__main__":
    main()
