"""Saving and loading maps: exactness, reproducible bytes, and errors for damaged files."""

import json
import struct

import pytest
import safetensors.torch
import torch

from spslam.errors import OutputError, SpslamError
from spslam.scene import Scene, SceneSettings
from tests.ops.test_in_place import default_dtype

SETTINGS = SceneSettings(0.04, 0.08, plane_cell_m=0.04, position_scale=0.25, max_voxels=10**6, max_texels=10**6)


@pytest.fixture
def scene(generator):
    scene = Scene(SETTINGS, seed=3, origin=torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    points = torch.rand(300, 3, generator=generator)
    scene.volume.insert(torch.randint(-8, 8, (20000, 3), generator=generator).int())
    scene.volume.embeddings.copy_(torch.randn(scene.volume.num_voxels, 8, generator=generator))
    scene.volume.weights.fill_(2)
    scene.planes.cover(points)
    return scene


def test_a_loaded_map_equals_the_saved_one(scene, tmp_path, generator):
    scene.save(tmp_path / "map.safetensors")
    loaded = Scene.load(tmp_path / "map.safetensors")
    assert loaded.settings == SETTINGS
    assert loaded.seed == 3
    state = scene.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in loaded.state_dict().items())
    points = torch.rand(500, 3, generator=generator) * 0.6 - 0.3
    for mine, other in zip(scene.sdf(points), loaded.sdf(points), strict=True):
        assert torch.equal(mine, other)
    assert scene.sdf(points)[1].any()
    assert torch.equal(scene.color(points), loaded.color(points))


def test_the_same_map_gives_the_same_bytes(scene, tmp_path):
    for name in ("one", "two"):
        scene.save(tmp_path / name)
    Scene.load(tmp_path / "one").save(tmp_path / "three")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes() == (tmp_path / "three").read_bytes()


def test_unused_capacity_is_not_saved(scene, tmp_path):
    scene.save(tmp_path / "map")
    tensors = sum(tensor.numel() * tensor.element_size() for tensor in scene.state_dict().values())
    assert tensors < (tmp_path / "map").stat().st_size < tensors + 2000


def test_an_empty_map_can_be_saved_and_loaded(tmp_path):
    Scene(SETTINGS, seed=0).save(tmp_path / "map")
    loaded = Scene.load(tmp_path / "map")
    assert loaded.volume.num_voxels == 0
    assert not loaded.sdf(torch.zeros(2, 3))[1].any()


def test_a_loaded_map_can_grow(scene, tmp_path):
    scene.save(tmp_path / "map")
    loaded = Scene.load(tmp_path / "map")
    new = torch.tensor([[100, 1, 2], [100, 1, 3]], dtype=torch.int32)
    assert torch.equal(scene.volume.insert(new), loaded.volume.insert(new))
    with pytest.raises(SpslamError, match="scene.max_texels = 1000000"):
        loaded.planes.cover(torch.full((1, 3), 1000.0))


def test_load_state_dict_copies(scene):
    other = Scene(SETTINGS, seed=3)
    other.load_state_dict(scene.state_dict())
    before = scene.geometry_decoder.clone()
    other.geometry_decoder.zero_()
    other.volume.embeddings.zero_()
    assert torch.equal(scene.geometry_decoder, before)
    assert scene.volume.embeddings.any()


def damage(path, change=lambda tensors: None, change_header=lambda header: None):
    """Writes the file anew with other tensors or another header."""
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["spslam"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    change(tensors)
    change_header(header)
    safetensors.torch.save_file(tensors, path, metadata={"spslam": json.dumps(header)})


def refused(path, message):
    with pytest.raises(SpslamError, match=f"map.safetensors: a damaged map .*{message}") as error:
        Scene.load(path)
    assert "\n" not in str(error.value)


def put(name, place, value):
    """A change of one number of a tensor."""

    def change(tensors):
        tensors[name][place] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("color_decoder"), "tensor color_decoder is missing"),
        (
            lambda t: t.update({"volume.embeddings": torch.zeros(4, 9)}),
            r"tensor volume.embeddings must be float32 \[\d+, 8\], got float32 \[4, 9\]",
        ),
        (
            lambda t: t.update({"volume.voxel_coords": t["volume.voxel_coords"].long()}),
            r"must be int32 \[\d+, 3\], got int64",
        ),
        (
            lambda t: t.update({"volume.weights": torch.zeros(4)}),
            r"tensor volume.weights must be float32 \[\d+\], got float32 \[4\]",
        ),
        (
            lambda t: t.update({"planes.texels": torch.zeros(5, 32)}),
            r"texels must have the \d+ rows of the layout, got 5",
        ),
        (lambda t: t.update({"planes.layout": t["planes.layout"].int()}), r"must be int64 \[15\], got int32 \[15\]"),
        (lambda t: t["volume.voxel_coords"].zero_(), "must be distinct"),
        (put("volume.voxel_coords", (3, 1), 2**20), "tensor volume.voxel_coords must be at most"),
        (put("volume.voxel_coords", (3, 1), -(2**31)), "tensor volume.voxel_coords must be at least"),
        (put("volume.embeddings", (5, 2), float("nan")), "tensor volume.embeddings must be finite"),
        (put("volume.weights", 7, -1.0), "tensor volume.weights must be at least 0, got -1"),
        (put("planes.texels", (1, 1), float("inf")), "tensor planes.texels must be finite"),
        (put("geometry_decoder", 1, float("nan")), "tensor geometry_decoder must be finite"),
        (put("origin", 1, float("inf")), "tensor origin must be finite"),
    ],
)
def test_a_damaged_map_gives_a_one_line_error(scene, tmp_path, change, message):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, change)
    refused(path, message)


@pytest.mark.parametrize("plane", [0, 1, 2])
@pytest.mark.parametrize("offset", [2**63 - 1, 2**62, -1, -(2**63), 1])
def test_planes_that_do_not_follow_each_other_are_refused(scene, tmp_path, plane, offset):
    """An offset that overflows when its plane's rows are added once passed the binding's check."""
    path = tmp_path / "map.safetensors"
    scene.save(path)
    rows = int(torch.prod(scene.state_dict()["planes.layout"][5 * plane + 3 : 5 * plane + 5]))
    damage(path, put("planes.layout", 5 * plane, offset - rows if offset == 2**63 - 1 else offset))
    refused(path, rf"layout of plane {plane} must begin at row \d+, got ")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((-1, -768), "must have sizes of at least 0, got -1 and -768"),
        ((2**31, 2**33), r"must stay within 2\^30 texels of the origin"),
        ((2**32 + 1, 0), r"must stay within 2\^30 texels of the origin"),
    ],
)
def test_sizes_of_planes_that_overflow_are_refused(scene, tmp_path, sizes, message):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, put("planes.layout", slice(3, 5), torch.tensor(sizes)))
    refused(path, f"layout of plane 0 {message}")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("voxel_size_m", 50.0, "voxel_size_m must be above 0 and at most 1, got 50.0"),
        ("voxel_size_m", 0, "voxel_size_m must be above 0 and at most 1, got 0"),
        ("voxel_size_m", "0.04", "voxel_size_m must be above 0 and at most 1, got '0.04'"),
        ("voxel_size_m", True, "voxel_size_m must be above 0 and at most 1, got True"),
        ("voxel_size_m", 0.5, "truncation_m must be at least voxel_size_m, got 0.08"),
        ("truncation_m", float("nan"), "truncation_m must be above 0 and at most 4, got nan"),
        ("plane_cell_m", -0.04, "plane_cell_m must be above 0 and at most 4, got -0.04"),
        ("position_scale", float("inf"), "position_scale must be above 0 and at most inf, got inf"),
        ("max_voxels", 0, "max_voxels must be a whole number from 1 to"),
        ("max_voxels", 10, "voxels must stay within scene.max_voxels = 10"),
        ("max_texels", "many", "max_texels must be a whole number from 1 to .*, got 'many'"),
        ("another", 1, "unexpected keyword argument 'another'"),
    ],
)
def test_settings_outside_the_options_ranges_are_refused(scene, tmp_path, name, value, message):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, change_header=lambda header: header["settings"].update({name: value}))
    refused(path, message)


@pytest.mark.parametrize("seed", ["seven", -1, 2**63, 1.5, None, True])
def test_seeds_that_are_none_are_refused(scene, tmp_path, seed):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, change_header=lambda header: header.update(seed=seed))
    refused(path, "seed must be a whole number from 0 to 9223372036854775807, got ")


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("[" * 5000, "it is nested too deep"),
        ('{"format": ' + "9" * 5000 + "}", "a whole number must have at most 20 digits, got 5000"),
        ("[]", "must contain an object with named values, got list"),
    ],
)
def test_a_header_that_is_none_is_one_line(scene, tmp_path, header, message):
    path = tmp_path / "map.safetensors"
    safetensors.torch.save_file(scene.state_dict(), path, metadata={"spslam": header})
    with pytest.raises(SpslamError, match=rf"map.safetensors: not a readable map \(spslam.*{message}\)"):
        Scene.load(path)


def test_a_header_of_gigabytes_is_not_read(tmp_path):
    path = tmp_path / "map.safetensors"
    with path.open("wb") as file:
        file.write(struct.pack("<Q", 90 << 20))
        file.truncate(100 << 20)
    with pytest.raises(SpslamError, match="its header must have at most 1048576 bytes, got 94371840"):
        Scene.load(path)


def test_unknown_tensors_are_ignored(scene, tmp_path):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, lambda tensors: tensors.update(another=torch.zeros(3, dtype=torch.complex64)))
    assert Scene.load(path).volume.num_voxels == scene.volume.num_voxels


def test_a_file_that_is_not_a_map_gives_a_one_line_error(scene, tmp_path):
    path = tmp_path / "map.safetensors"
    with pytest.raises(SpslamError, match="no such map file"):
        Scene.load(path)
    scene.save(path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(SpslamError, match="not a readable map"):
        Scene.load(path)
    path.write_text("hello")
    with pytest.raises(SpslamError, match="not a readable map"):
        Scene.load(path)
    safetensors.torch.save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(SpslamError, match="not a map of format spslam-map-1"):
        Scene.load(path)


def test_a_missing_folder_is_an_output_error(scene, tmp_path):
    with pytest.raises(OutputError, match="can't be written"):
        scene.save(tmp_path / "none" / "map.safetensors")


def test_another_default_dtype_changes_nothing():
    scenes = []
    for dtype in (torch.float32, torch.float64):
        with default_dtype(dtype):
            scenes.append(Scene(SETTINGS, seed=0))
            scenes[-1].volume.insert(torch.zeros(1, 3, dtype=torch.int32))
            scenes[-1].planes.cover(torch.ones(1, 3))
            scenes[-1].view().check("test")
    state = scenes[0].state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in scenes[1].state_dict().items())
    assert all(tensor.dtype == state[name].dtype for name, tensor in scenes[1].state_dict().items())


def test_a_view_is_kept_until_the_scene_is_another(scene):
    """Each frame asks for it: it must be that of the scene as it is, whatever was changed."""

    def is_current(view):
        tensors = {"texels": scene.planes.texels, "geometry_params": scene.geometry_decoder}
        tensors |= {"color_params": scene.color_decoder, "embeddings": scene.volume.embeddings}
        same = all(getattr(view, name).data_ptr() == tensor.data_ptr() for name, tensor in tensors.items())
        return same and len(view.embeddings) == len(view.corner_ids) == scene.volume.num_voxels

    first = scene.view()
    assert scene.view() is first and is_current(first)
    changes = (
        lambda: scene.volume.insert(torch.tensor([[1000, 1000, 1000]], dtype=torch.int32)),
        lambda: scene.volume.insert(torch.arange(3 * scene.volume.capacity, dtype=torch.int32).view(-1, 3)),
        lambda: scene.planes.cover(torch.full((1, 3), 5.0)),
        lambda: setattr(scene, "geometry_decoder", scene.geometry_decoder.clone()),
        lambda: setattr(scene, "color_decoder", scene.color_decoder.clone()),
        lambda: scene.load_state_dict({name: one.clone() for name, one in scene.state_dict().items()}),
    )
    for change in changes:
        before = scene.view()
        change()
        assert scene.view() is not before and is_current(scene.view())
    assert scene.view() is scene.view()
