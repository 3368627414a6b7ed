"""What the package is beside its kernels: types for checkers, enums, and the hash as an object."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import spslam_numpy as sn
import torch

from spslam import ops

FOLDER = Path(sn.__file__).parent
STUB = ast.parse((FOLDER / "__init__.pyi").read_text())


def stub_parameters(function):
    """name -> whether it has a default, as the stub has them."""
    arguments = function.args
    defaults = [None] * (len(arguments.args) - len(arguments.defaults)) + arguments.defaults
    named = [
        *zip(arguments.args, defaults, strict=True),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]
    return {argument.arg: default is not None for argument, default in named}


def compiled_parameters(function):
    """The same from the signature that pybind11 writes at the head of a docstring."""
    listed = re.match(r"\w+\((.*)\) -> ", function.__doc__)[1]
    parts = re.findall(r"(\w+): [\w.\[\], |:]*?(?:\[[^=]*?\])?( = [^,()]+| = \([^)]*\))?(?:, |$)", listed)
    return {name: bool(default) for name, default in parts}


def test_the_stub_has_every_name():
    named = {node.name for node in STUB.body if isinstance(node, ast.FunctionDef)}
    values = {node.target.id for node in STUB.body if isinstance(node, ast.AnnAssign)}
    classes = {alias.asname for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(sn.__all__) <= named | values | classes
    assert named <= set(sn.__all__)


@pytest.mark.parametrize("function", [node for node in STUB.body if isinstance(node, ast.FunctionDef)])
def test_the_stub_has_the_arguments_of_a_function(function):
    assert stub_parameters(function) == compiled_parameters(getattr(sn, function.name))


def test_arguments_are_those_of_the_torch_ops():
    """Where the NumPy function has less, it is what only torch has: devices, matrix units, and networks beyond the
    kernel's, which are made of torch's own operations."""
    only_torch = {"device", "tf32"}
    of_mlp = {"layers", "hidden_activation", "scale", "bias"}
    for node in STUB.body:
        if isinstance(node, ast.FunctionDef) and hasattr(ops, node.name):
            theirs = inspect.signature(getattr(ops, node.name)).parameters
            left_out = only_torch | (of_mlp if node.name.startswith("mlp") else set())
            assert [*stub_parameters(node)] == [name for name in theirs if name not in left_out]


def test_a_type_checker_sees_the_types(tmp_path):
    pytest.importorskip("mypy")
    assert (FOLDER / "py.typed").is_file()
    program = tmp_path / "program.py"
    program.write_text(
        "import numpy as np\n"
        "import spslam_numpy as sn\n"
        "from numpy.typing import NDArray\n"
        "keys, values = sn.new_voxel_hash(8)\n"
        "ids: NDArray[np.int32] = sn.voxel_hash_find(keys, values, np.zeros((1, 3), np.int32))\n"
        "ids = sn.VoxelHash().find(np.zeros((1, 3), np.int32))\n"
        "activation: sn.Activation = sn.Activation.TANH\n"
        "sn.mlp(np.zeros((1, 3)), np.zeros(9), hidden=1.5, output=1)\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", program.name], cwd=tmp_path, capture_output=True, text=True
    )
    assert 'program.py:8: error: Argument "hidden" to "mlp" has incompatible type "float"' in done.stdout
    assert "Found 1 error" in done.stdout


def test_enums_are_those_of_the_torch_ops():
    for name in ("Activation", "RandomStream"):
        own, theirs = getattr(sn, name), getattr(ops, name)
        # The kernel of `mlp` has fewer activations than what torch's operations make of it.
        known = own.__members__ if name == "Activation" else theirs.__members__
        assert {member.name: member.value for member in own} == {key: theirs[key].value for key in known}
    x, params = np.ones((2, 3), np.float32), np.full(sn.mlp_num_params(3, 4, 1), 0.1, np.float32)
    assert np.array_equal(sn.mlp(x, params, 4, 1, sn.Activation.TANH), sn.mlp(x, params, 4, 1, 1))
    assert len(sn.philox_uniform(0, sn.RandomStream.EVALUATION, 0, 0, 5)) == 5


def test_the_hash_grows_as_that_of_torch():
    rng = np.random.default_rng(0)
    own, theirs = sn.VoxelHash(capacity=1), ops.VoxelHash(capacity=1)
    for _ in range(5):
        coords = rng.integers(-9, 9, (600, 3), dtype=np.int32)
        assert own.insert(coords).tolist() == theirs.insert(torch.from_numpy(coords)).tolist()
        assert own.capacity == theirs.capacity
        for name in ("hash_keys", "hash_values", "coords_buffer", "corners_buffer"):
            assert np.array_equal(getattr(own, name), getattr(theirs, name).numpy())
    points = rng.uniform(-1, 1, (200, 3)).astype(np.float32)
    for got, want in zip(own.lookup(points, 0.1), theirs.lookup(torch.from_numpy(points), 0.1), strict=True):
        assert np.array_equal(got, want.numpy())
    reversed_coords = own.voxel_coords[::-1].copy()
    own.build(reversed_coords)
    assert own.find(reversed_coords).tolist() == list(range(len(own)))


def test_the_hash_stays_as_it_was_where_it_refuses():
    cells = sn.VoxelHash(max_voxels=4)
    cells.insert(np.array([[0, 0, z] for z in range(3)], np.int32))
    with pytest.raises(sn.VoxelLimitError, match="voxels must stay within max_voxels = 4, got 5") as limit:
        cells.insert(np.array([[1, 0, 0], [1, 0, 1], [1, 0, 0]], np.int32))
    assert (limit.value.wanted, limit.value.max_voxels) == (5, 4)
    with pytest.raises(RuntimeError, match=r"VoxelHash.insert: voxel_coords must lie in .*, got 1 rows outside"):
        cells.insert(np.array([[1, 0, 0], [2**20, 0, 0]], np.int32))
    with pytest.raises(ValueError, match="VoxelHash.build: voxel_coords must be distinct, got a repeated row"):
        cells.build(np.zeros((2, 3), np.int32))
    assert len(cells) == 3
    assert cells.find(np.array([[0, 0, 2], [1, 0, 0]], np.int32)).tolist() == [2, -1]


@pytest.mark.parametrize(
    "call, kind, message",
    [
        (lambda: sn.VoxelHash(8.0), TypeError, "VoxelHash: capacity must be an int, got float"),
        (lambda: sn.VoxelHash(0), ValueError, "VoxelHash: capacity must be at least 1, got 0"),
        (lambda: sn.VoxelHash(max_voxels=0), ValueError, "VoxelHash: max_voxels must be at least 1, got 0"),
        (
            lambda: sn.VoxelHash().insert([1]),
            TypeError,
            "VoxelHash.insert: voxel_coords must be a numpy.ndarray, got list",
        ),
        (
            lambda: sn.VoxelHash().find(np.zeros((1, 3))),
            TypeError,
            "VoxelHash.find: voxel_coords must be int32, got float64",
        ),
        (
            lambda: sn.VoxelHash().build(np.zeros(3, np.int32)),
            ValueError,
            r"VoxelHash.build: voxel_coords must have shape \[N, 3\], got \[3\]",
        ),
    ],
)
def test_errors_of_the_hash(call, kind, message):
    with pytest.raises(kind, match=f"^{message}"):
        call()


@pytest.mark.parametrize("plane", range(3))
@pytest.mark.parametrize("bad", [(2**63 - 4, 0, 0, 2, 2), (0, 0, 0, 2**62, 4), (0, 2**40, 0, 2, 2), (-1, 0, 0, 2, 2)])
def test_a_layout_that_overflows_is_refused(plane, bad):
    layout = [0, 0, 0, 2, 2, 4, 0, 0, 2, 2, 8, 0, 0, 2, 2]
    layout[5 * plane : 5 * plane + 5] = bad
    with pytest.raises(ValueError, match="tri_plane_interpolate: layout must "):
        sn.tri_plane_interpolate(np.ones((12, 1), np.float32), np.zeros((1, 3), np.float32), 0.04, layout)


def test_a_full_table():
    """An insertion for which there is no slot is refused, and a search ends."""
    keys, values = np.arange(16, dtype=np.int64), np.zeros(16, np.int32)
    coords = np.array([[5, 5, 5]], np.int32)
    assert sn.voxel_hash_find(keys, values, coords).tolist() == [-1]
    with pytest.raises(RuntimeError, match="first_id must be the number of voxels in the table, got 0"):
        sn.voxel_hash_insert(keys, values, coords, 0)
    with pytest.raises(ValueError, match="mlp: hidden must be at most 2\\^30"):
        sn.mlp(np.zeros((1, 2), np.float32), np.zeros(5, np.float32), 2**32, 1)
