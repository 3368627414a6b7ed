"""Builds the kernel libraries with CMake and puts them and configs/ into the package; the rest is in pyproject.toml."""

import os
import pathlib
import shlex
import subprocess
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent / "cmake"))

from setuptools import Extension, find_packages, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.config.pyprojecttoml import load_file
from spslam_build import cuda_setting, readme_for_index, torch_dir

OPTIONS = ("SPSLAM_CUDA_ARCHS", "SPSLAM_CPU_ISAS")
ROOT = pathlib.Path(__file__).parent.resolve()
# Folders without modules are packages too, so that setuptools takes what lies in them.
DATA_PACKAGES = {
    "spslam.benchmark.data": ["*.yaml"],
    "spslam.benchmark.data.suites": ["*.yaml"],
    "spslam.evaluation.web": ["*.js", "*.css", "*.LICENSE"],
    "spslam.prior.data": ["*.safetensors"],
}
REPOSITORY = load_file(ROOT / "pyproject.toml")["project"]["urls"]["Homepage"]


class CMakeBuild(build_ext):
    """Runs CMake once for all op libraries."""

    def get_ext_filename(self, fullname):
        return fullname.replace(".", os.sep) + ".so"

    def get_outputs(self):
        return [str(path) for path in (pathlib.Path(self.build_lib) / "spslam").glob("_*.so")]

    def run(self):
        if self.inplace and os.environ.get("SPSLAM_BUILD") == "OFF":
            return  # an editable install whose kernels come from `make dev`
        torch = torch_dir()
        if torch is None:
            raise SystemExit("spslam: torch is not installed; install torch >= 2.11 first, or set SPSLAM_TORCH_DIR")
        build = pathlib.Path(self.build_temp).resolve()
        destination = ROOT if self.inplace else pathlib.Path(self.build_lib).resolve()
        build.mkdir(parents=True, exist_ok=True)
        arguments = [f"-DSPSLAM_TORCH_DIR={torch}", f"-DCMAKE_INSTALL_PREFIX={destination}"]
        cuda, notice = cuda_setting(torch, os.environ.get("SPSLAM_CUDA"))
        if notice:
            print(notice, file=sys.stderr)
        arguments += [f"-DSPSLAM_CUDA={cuda}"]
        arguments += [f"-D{name}={os.environ[name]}" for name in OPTIONS if os.environ.get(name)]
        arguments += shlex.split(os.environ.get("CMAKE_ARGS", ""))
        # --fresh: what an earlier build found (ninja, torch) lay in pip's temporary environment, and is gone.
        subprocess.check_call(["cmake", "--fresh", "-S", str(ROOT), "-B", str(build), "-G", "Ninja", *arguments])
        jobs = os.environ.get("MAX_JOBS") or os.environ.get("CMAKE_BUILD_PARALLEL_LEVEL")
        subprocess.check_call(["cmake", "--build", str(build), *(["-j", jobs] if jobs else [])])
        for component in ("python", "images"):
            subprocess.check_call(["cmake", "--install", str(build), "--component", component])


class PlatformWheel(bdist_wheel):
    """The libraries hold no Python symbol, so one wheel serves every Python 3."""

    def get_tag(self):
        return "py3", "none", super().get_tag()[2]


CONFIG_PACKAGES = {
    "spslam.configs": "configs",
    "spslam.configs.presets": "configs/presets",
    "spslam.configs.models": "configs/models",
}

setup(
    long_description=readme_for_index((ROOT / "README.md").read_text(encoding="utf-8"), REPOSITORY),
    long_description_content_type="text/markdown",
    packages=[*find_packages(include=["spslam", "spslam.*"]), *DATA_PACKAGES, *CONFIG_PACKAGES],
    package_dir=CONFIG_PACKAGES,
    package_data={
        "spslam": ["py.typed"],
        **DATA_PACKAGES,
        **{name: ["*.yaml"] for name in CONFIG_PACKAGES},
    },
    ext_modules=[Extension("spslam._ops_cpu", sources=[])],
    cmdclass={"build_ext": CMakeBuild, "bdist_wheel": PlatformWheel},
)
