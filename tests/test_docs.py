"""The documentation agrees with the code."""

import functools
import importlib.util
import re
from pathlib import Path

import pytest

from spslam.cli.cluster import OPTIONS as CLUSTER_OPTIONS
from spslam.cli.main import COMMANDS
from spslam.config import option_paths

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
# Dated experiments are not updated, so the options and scripts that they name may be gone; everything else is current.
RECORDS = [page for page in PAGES if page.parent.name == "experiments" and page.name != "index.md"]
CURRENT = [page for page in PAGES if page not in RECORDS]
NAMING = [ROOT / name for name in ("spslam", "tests", "docs", "experiments", "examples", "csrc", "bindings", "configs")]


def page_id(page):
    return str(page.relative_to(ROOT))


def links(page):
    """Target and anchor of every link and picture of a page, those to other sites left out."""
    found = re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", page.read_text(encoding="utf-8"))
    return [(target, anchor) for target, anchor in found if not target.startswith(("http:", "https:", "mailto:"))]


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


# Pages whose programs are run here; those of the others are run by the test named.
RUN_HERE = ("README.md", "docs/configuration.md", "docs/graph.md", "docs/places.md", "docs/viewer.md")
RUN_ELSEWHERE = {
    "docs/fit-your-field.md": "tests/examples/test_fit.py",
    "docs/library.md": "tests/examples/test_live_examples.py",
    "docs/live.md": "tests/examples/test_live_examples.py",
    "docs/notebook.md": "tests/examples/test_live_examples.py",
    "docs/numpy.md": "bindings/numpy/tests/test_arrays.py",
    "docs/port-to-ops.md": "tests/ops/test_ports.py",
    "docs/posed-fusion.md": "tests/test_docs_examples.py",
    "docs/ros2.md": "tests/examples/test_ros2_node.py",
}
PROGRAMS = [(name, block) for name in RUN_HERE for block in python_blocks(ROOT / name)]


@pytest.mark.parametrize(("name", "block"), PROGRAMS, ids=[name for name, _ in PROGRAMS])
def test_examples_run(tmp_path, monkeypatch, name, block):
    if "spslam.viewer" in block:
        pytest.importorskip("viser", reason="viser is not installed: pip install 'spslam[viewer]'")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, name, "exec"), {})


def test_every_program_is_run():
    ops_pages = {page for page in CURRENT if page.parent == ROOT / "docs" / "ops"}  # by tests/test_docs_examples.py
    pages = {page_id(page) for page in CURRENT if page not in ops_pages and python_blocks(page)}
    assert pages == {*RUN_HERE, *RUN_ELSEWHERE}
    assert all((ROOT / test).is_file() for test in RUN_ELSEWHERE.values())


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


def test_cluster_page_has_the_options_as_the_command_explains_them():
    """The table of docs/cluster.md is the help of `spslam run` and `spslam bench`."""
    page = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(--\S+)[^`]*` \| (.*) \|$", page, re.MULTILINE)
    assert dict(rows) == {name: argument["help"] for name, argument in CLUSTER_OPTIONS.items()}


def headings(page):
    """Anchors of a page, as they are made of its headings."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page):
    for target, anchor in links(page):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in headings(file), f"{target}#{anchor}"


@pytest.mark.parametrize("folder", ["docs", "docs/ops", "docs/experiments"])
def test_every_page_is_in_its_index(folder):
    index = ROOT / folder / "index.md"
    linked = {(index.parent / target).resolve() for target, _ in links(index)}
    assert not [page.name for page in index.parent.glob("*.md") if page != index and page not in linked]


@pytest.mark.parametrize("page", CURRENT, ids=page_id)
def test_commands_and_options_named_exist(page):
    text = page.read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"```\w*\n(.*?)```", text, re.DOTALL) + re.findall(r"`(spslam [^`]*)`", text))
    assert set(re.findall(r"^\s*(?:\$ )?spslam ([a-z-]+)", code, re.MULTILINE)) <= set(COMMANDS)
    for option in re.findall(r"--set ([\w.]+)=", text):
        assert option in set(option_paths()) | {"section.key"}


@pytest.mark.parametrize("page", [page for page in CURRENT if page.name != "CHANGELOG.md"], ids=page_id)
def test_scripts_and_files_named_exist(page):
    """Of `python -m experiments.NAME`, and of paths in backticks such as `slam/state.py` or `configs/tum.yaml`."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"python -m experiments\.([a-z]\w*)", text):
        assert (ROOT / "experiments" / f"{name}.py").is_file(), name
    for path in re.findall(r"`([\w/]+/\w+\.(?:py|yaml|h|cuh|cpp|cu))`", text):
        assert (ROOT / path).is_file() or (ROOT / "spslam" / path).is_file(), path


def exists(name):
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        module = ".".join(parts[:count])
        try:
            found = importlib.util.find_spec(module) is not None
        except ModuleNotFoundError:
            continue
        if found:
            value = importlib.import_module(module)
            return functools.reduce(lambda owner, part: getattr(owner, part, None), parts[count:], value) is not None
    return False


@pytest.mark.parametrize("folder", NAMING, ids=lambda folder: folder.name)
def test_modules_named_in_backticks_exist(folder):
    """Such as `spslam.run.sequence` or `spslam.meshing.load_mesh`, in pages, docstrings, comments and messages."""
    files = [path for suffix in ("md", "py", "h", "cpp", "cu", "cuh", "yaml") for path in folder.rglob(f"*.{suffix}")]
    named = {
        (path, name)
        for path in files
        if path not in RECORDS
        for name in re.findall(r"`(spslam(?:\.[A-Za-z_]\w*)+)", path.read_text(encoding="utf-8"))
    }
    assert not [f"{path.relative_to(ROOT)}: {name}" for path, name in sorted(named) if not exists(name)]


@pytest.mark.parametrize("page", RECORDS, ids=page_id)
def test_experiments_are_dated_and_say_where_they_come_from(page):
    assert re.fullmatch(r"20\d\d-[01]\d-[a-z-]+", page.stem)
    text = page.read_text(encoding="utf-8")
    assert all(re.search(rf"^\| {row} \| .+ \|$", text, re.MULTILINE) for row in ("status", "commit", "machine"))
