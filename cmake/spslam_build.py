"""In-tree PEP 517 backend: setuptools, plus "build against the torch that is already installed".

pip's isolated build hides site-packages from sys.path but runs the same interpreter, so sysconfig still names the
target environment's folders: the headers of the torch there are used without importing it, and pip downloads no second
one. Only when there is none is torch asked for as a build requirement.
"""

import importlib.util
import os
import pathlib
import re
import sysconfig

from setuptools import build_meta as _setuptools
from setuptools.build_meta import *  # noqa: F403

_ABSOLUTE = r"https?:|mailto:"


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


def cuda_setting(torch: pathlib.Path, chosen: str | None) -> tuple[str, str | None]:
    """What CMake is given as SPSLAM_CUDA, and a line for the user where that leaves CUDA out.

    Without a choice, or with AUTO, CUDA kernels are built only for a CUDA build of torch (then CMake looks for nvcc):
    they can't be used with any other. A torch that pip fetched for the build is of the kind that it installs with
    spslam, as both come from the same index.

    Args:
        torch: folder of the torch package to build against.
        chosen: the user's SPSLAM_CUDA.
    """
    if chosen and chosen.upper() != "AUTO":
        return chosen, None
    if (torch / "lib" / "libtorch_cuda.so").exists():
        return "AUTO", None
    return "OFF", f"spslam: no CUDA kernels: the torch in {torch} is a CPU build; set SPSLAM_CUDA=ON to build them"


def readme_for_index(text: str, url: str) -> str:
    """The README as a package index shows it: links and images of the repository by their addresses.

    Args:
        text: in Markdown, with links relative to the repository.
        url: of the repository.
    """
    raw = url.replace("https://github.com/", "https://raw.githubusercontent.com/")
    text = re.sub(rf"(!\[[^\]]*\]\()(?!{_ABSOLUTE})", rf"\g<1>{raw}/main/", text)
    return re.sub(rf"((?<!!)\[[^\]]*\]\()(?!{_ABSOLUTE}|#)", rf"\g<1>{url}/blob/main/", text)


def _torch_requirement() -> list[str]:
    return [] if torch_dir() else ["torch>=2.11"]


def get_requires_for_build_wheel(config_settings=None):
    return _setuptools.get_requires_for_build_wheel(config_settings) + _torch_requirement()


def get_requires_for_build_editable(config_settings=None):
    return _setuptools.get_requires_for_build_editable(config_settings) + _torch_requirement()


if __name__ == "__main__":
    print(torch_dir() or "")
