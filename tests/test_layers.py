"""The layers of the house: who may include and import whom, and who may print or exit."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = sorted(path for path in (ROOT / "csrc").rglob("*") if path.suffix in (".h", ".cuh", ".cpp", ".cu"))
MODULES = sorted((ROOT / "spslam").rglob("*.py"))

# Which folders of csrc a file of a folder may include, beside system headers.
INCLUDES = {
    "core": {"core"},
    "include": {"core", "include"},
    "kernels": {"core", "include", "kernels"},
    "launch": {"core", "include", "kernels", "launch"},
    "cpu": {"core", "include", "kernels", "launch", "cpu"},
    "cuda": {"core", "include", "kernels", "launch", "cuda"},
    "bindings": {"core", "include", "bindings"},
}
# The maths of one element runs on both devices, so it knows only what both have.
ELEMENT_SYSTEM_HEADERS = {"cmath", "cstdint", "limits"}

# More become a struct of options, or a list of numbers where they are an op's.
MAX_PARAMETERS = 12

# Which parts of spslam a part may import. Parts that aren't named here are of the ground floor.
GROUND = {
    "camera",
    "config",
    "errors",
    "geometry",
    "helper_process",
    "image_library",
    "io",
    "loading",
    "notebook",
    "options",
    "pose_graph",
    "reading",
    "run_folder",
    "tensor_file",
    "tensor_rules",
    "tensor_schema",
    "trajectory",
}
IMPORTS = {
    **{name: GROUND for name in GROUND},
    "ops": set(),
    "tasks": GROUND,
    "datasets": GROUND,
    "download": GROUND,
    "scene": GROUND | {"ops"},
    "prior": GROUND | {"ops"},
    "meshing": GROUND | {"ops", "scene", "datasets"},
    "evaluation": GROUND | {"ops", "scene", "datasets", "meshing"},
    "slam": GROUND | {"ops", "scene", "prior", "datasets", "meshing"},
    "run": GROUND | {"ops", "scene", "prior", "datasets", "meshing", "evaluation", "slam", "tasks"},
    "viewer": GROUND | {"ops", "scene", "datasets", "meshing", "evaluation", "slam", "run"},
    "benchmark": GROUND | {"ops", "scene", "prior", "datasets", "meshing", "evaluation", "slam", "run", "tasks"},
    "live": GROUND | {"ops", "scene", "prior", "datasets", "meshing", "evaluation", "slam", "run"},
    "cli": GROUND
    | {"download", "ops", "scene", "prior", "datasets", "meshing", "evaluation", "slam", "run", "live", "viewer"}
    | {"benchmark", "tasks"},
}


def relative(path):
    return str(path.relative_to(ROOT))


def includes(path):
    return re.findall(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]', path.read_text(), re.MULTILINE)


def layer_of(header):
    first = header.split("/")[0]
    return "include" if first == "spslam" else first


def part_of(path):
    """`scene` for spslam/scene/x.py, `camera` for spslam/camera.py, `` for spslam/__init__.py."""
    first = path.relative_to(ROOT / "spslam").parts[0].removesuffix(".py")
    return {"__init__": "", "__main__": "cli"}.get(first, first)


def imported(path):
    """Absolute names of all modules that a file imports, wherever in it."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield from (f"{module}.{alias.name}" for alias in node.names)


def spslam_parts(path):
    names = (name.split(".") for name in imported(path))
    return {name[1] for name in names if name[0] == "spslam" and len(name) > 1 and not name[1].startswith("__")}


def test_there_is_something_to_check():
    assert len(SOURCES) > 10
    assert len(MODULES) > 10


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_source_includes_only_lower_layers(path):
    layer = path.relative_to(ROOT / "csrc").parts[0]
    for header in includes(path):
        if (ROOT / "csrc" / header).exists() or (ROOT / "csrc/include" / header).exists():
            assert layer_of(header) in INCLUDES[layer], f"{layer} must not include {header}"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_torch_is_known_to_bindings_alone(path):
    if path.relative_to(ROOT / "csrc").parts[0] != "bindings":
        assert not [header for header in includes(path) if re.match(r"(torch|ATen|c10|pybind11)/|Python\.h", header)]


@pytest.mark.parametrize("path", [path for path in SOURCES if path.parent.name in ("kernels", "types")], ids=relative)
def test_element_functions_know_only_mathematics(path):
    system = {header for header in includes(path) if "/" not in header}
    assert system <= ELEMENT_SYSTEM_HEADERS


@pytest.mark.parametrize("path", [path for path in SOURCES if path.parent.name == "bindings"], ids=relative)
def test_bindings_use_the_stable_abi_alone(path):
    foreign = [
        header for header in includes(path) if re.match(r"(ATen|c10|pybind11)/|Python\.h|torch/extension", header)
    ]
    assert not foreign
    torch_headers = [header for header in includes(path) if header.startswith("torch/")]
    stable = r"torch/(csrc/stable|headeronly|csrc/inductor/aoti_torch/c)/"
    assert all(re.match(stable, header) for header in torch_headers)


def argument_counts(text):
    """Name and number of arguments of everything in C++ that looks like a function's declaration or call."""
    code = re.sub(r'//[^\n]*|"(\\.|[^"\\])*"', "", text)
    for match in re.finditer(r"(\w+)(<[^<>()]*>)?\(", code):
        depth, angles, count = 1, 0, 1
        for character in code[match.end() :]:
            depth += (character in "([{") - (character in ")]}")
            angles += (character == "<") - (character == ">")
            count += character == "," and depth == 1 and angles == 0
            if depth == 0:
                break
        yield match[1], count


def test_arguments_are_counted():
    text = "void f(std::map<int, int> a, int (*b)(int, int), T c = g(1, 2, 3));  // h(1, 2)"
    assert list(argument_counts(text)) == [("f", 3), ("g", 3)]


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_functions_take_few_parameters(path):
    assert not [name for name, count in argument_counts(path.read_text()) if count > MAX_PARAMETERS]


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_module_imports_only_lower_layers(path):
    part = part_of(path)
    if not part:
        return
    allowed = set(IMPORTS[part]) | {part}
    assert spslam_parts(path) <= allowed, f"{part} may import {sorted(allowed)} only"


def test_tracker_and_mapper_do_not_know_each_other():
    names = {"tracker": "mapper", "mapper": "tracker"}
    for path in MODULES:
        if part_of(path) == "slam" and path.stem in names:
            assert not [name for name in imported(path) if names[path.stem] in name.split(".")]


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_package_needs_nothing_of_the_repository(path):
    """`tests` and `experiments` are not in the wheel."""
    assert not {name.split(".")[0] for name in imported(path)} & {"experiments", "tests", "tools"}


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_ops_alone_name_the_torch_library(path):
    if part_of(path) != "ops":
        assert "torch.ops.spslam" not in path.read_text()


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_command_line_alone_prints_parses_and_exits(path):
    if part_of(path) == "cli":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            assert name not in ("print", "exit", "quit", "sys.exit", "os._exit", "sys.stdout.write", "sys.stderr.write")
        assert not (isinstance(node, ast.Name) and node.id == "SystemExit")
    assert not {name.split(".")[0] for name in imported(path)} & {"argparse", "tqdm", "click"}


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_input_is_not_checked_by_assert(path):
    assert not [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Assert)]


@pytest.mark.parametrize("path", SOURCES + MODULES, ids=relative)
def test_files_stay_readable(path):
    assert len(path.read_text().splitlines()) <= 400
