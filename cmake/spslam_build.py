"""In-tree PEP 517 backend: setuptools, plus "build against the torch that is already installed".

pip's isolated build hides site-packages from sys.path but runs the same interpreter, so sysconfig still names the
target environment's folders: the headers of the torch there are used without importing it, and pip downloads no second
one. Only when there is none is torch asked for as a build requirement.
"""

import importlib.util
import os
import pathlib
import sysconfig

from setuptools import build_meta as _setuptools
from setuptools.build_meta import *  # noqa: F403


def torch_dir() -> pathlib.Path | None:
    """Folder of the torch package to build against, or None."""
    if chosen := os.environ.get("SPSLAM_TORCH_DIR"):
        return pathlib.Path(chosen)
    spec = importlib.util.find_spec("torch")
    if spec and spec.origin:
        return pathlib.Path(spec.origin).parent
    for scheme_key in ("platlib", "purelib"):
        candidate = pathlib.Path(sysconfig.get_path(scheme_key)) / "torch"
        if (candidate / "version.py").exists():
            return candidate
    return None


def _torch_requirement() -> list[str]:
    return [] if torch_dir() else ["torch>=2.11"]


def get_requires_for_build_wheel(config_settings=None):
    return _setuptools.get_requires_for_build_wheel(config_settings) + _torch_requirement()


def get_requires_for_build_editable(config_settings=None):
    return _setuptools.get_requires_for_build_editable(config_settings) + _torch_requirement()


if __name__ == "__main__":
    print(torch_dir() or "")
