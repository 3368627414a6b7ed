"""What an installed package holds and says, and how the build decides what to build."""

import importlib.util
import re
from pathlib import Path

import pytest

import spslam

FOLDER = Path(spslam.__file__).parent
ROOT = Path(__file__).parent.parent


@pytest.fixture
def build():
    """The build backend, `cmake/spslam_build.py`."""
    spec = importlib.util.spec_from_file_location("spslam_build", ROOT / "cmake" / "spslam_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_folder_with_modules_is_a_package():
    """Setuptools takes folders that are packages, and nothing says so of one that is not."""
    folders = {path.parent for path in FOLDER.rglob("*.py")}
    assert [str(folder) for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []


def test_an_index_gets_a_readme_without_relative_links(build):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = build.readme_for_index(text, "https://github.com/me/it")
    links = re.findall(r"\]\(([^)]+)\)", shown)
    assert len(links) == len(re.findall(r"\]\(([^)]+)\)", text)) > 5
    assert all(re.match(r"https://|#", link) for link in links)
    assert "https://github.com/me/it/blob/main/docs/install.md" in links
    assert "https://raw.githubusercontent.com/me/it/main/docs/images/demo.jpg" in links


def test_absolute_links_and_anchors_are_left_alone(build):
    text = "[a](https://b.c) [d](#e) ![f](http://g.h) [i](mailto:j) `k](l)`"
    assert build.readme_for_index(text, "https://github.com/me/it") == text


@pytest.mark.parametrize("chosen", [None, "", "AUTO", "auto"])
def test_cuda_kernels_are_built_for_a_cuda_build_of_torch(build, tmp_path, chosen):
    setting, line = build.cuda_setting(tmp_path, chosen)
    assert setting == "OFF"
    assert line == f"spslam: no CUDA kernels: the torch in {tmp_path} is a CPU build; set SPSLAM_CUDA=ON to build them"
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libtorch_cuda.so").touch()
    assert build.cuda_setting(tmp_path, chosen) == ("AUTO", None)


@pytest.mark.parametrize("chosen", ["ON", "OFF"])
def test_a_choice_of_cuda_is_kept(build, tmp_path, chosen):
    assert build.cuda_setting(tmp_path, chosen) == (chosen, None)


def test_the_ops_alone_are_of_the_same_version():
    """The distribution spslam-ops has spslam's ops under its own version number."""
    text = (ROOT / "bindings/ops/pyproject.toml").read_text(encoding="utf-8")
    own = (ROOT / "bindings/ops/python/spslam/__init__.py").read_text(encoding="utf-8")
    assert f'version = "{spslam.__version__}"' in text
    assert f'__version__ = "{spslam.__version__}"' in own
    assert 'dependencies = ["torch>=2.11"]' in text
