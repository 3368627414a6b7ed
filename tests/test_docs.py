"""The documentation agrees with the code."""

import importlib.util
import re
from pathlib import Path

import pytest

from spslam.cli.main import COMMANDS
from spslam.config import option_paths

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("block", python_blocks(ROOT / "README.md") + python_blocks(ROOT / "docs" / "configuration.md"))
def test_examples_run(tmp_path, monkeypatch, block):
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "example", "exec"), {})


def generator():
    spec = importlib.util.spec_from_file_location("generate_configuration", ROOT / "docs" / "generate_configuration.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_configuration_page_is_current():
    expected = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert generator().page() == expected, "run python docs/generate_configuration.py"


def test_configuration_page_has_every_option():
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert not [option for option in option_paths() if f"| `{option}` |" not in page]


def headings(page):
    """Anchors of a page, as they are made of its headings."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:", "mailto:")):
            file = page.parent / target if target else page
            assert file.exists(), target
            assert not anchor or anchor in headings(file), f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_and_options_named_exist(page):
    text = page.read_text(encoding="utf-8")
    assert {name for name in re.findall(r"^\s*(?:\$ )?spslam ([a-z-]+)", text, re.MULTILINE)} <= set(COMMANDS)
    for option in re.findall(r"--set ([\w.]+)=", text):
        assert option in set(option_paths()) | {"section.key"}
