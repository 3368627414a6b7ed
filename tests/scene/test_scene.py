"""Saving and loading maps: exactness, reproducible bytes, and errors for damaged files."""

import pytest
import safetensors.torch
import torch

from spslam.errors import OutputError, SpslamError
from spslam.scene import Scene, SceneSettings

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


def damage(path, change):
    with safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    change(tensors)
    safetensors.torch.save_file(tensors, path, metadata=metadata)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("color_decoder"), "tensor color_decoder is missing"),
        (
            lambda t: t.update({"volume.embeddings": torch.zeros(4, 9)}),
            r"must be torch.float32 \[any, 8\], got torch.float32 \[4, 9\]",
        ),
        (
            lambda t: t.update({"volume.voxel_coords": t["volume.voxel_coords"].long()}),
            r"must be torch.int32 \[any, 3\], got torch.int64",
        ),
        (lambda t: t.update({"volume.weights": torch.zeros(4)}), "the volume's tensors differ in length"),
        (lambda t: t.update({"planes.texels": torch.zeros(5, 32)}), "texels must have the rows of layout"),
        (lambda t: t["volume.voxel_coords"].zero_(), "must be distinct"),
    ],
)
def test_a_damaged_map_gives_a_one_line_error(scene, tmp_path, change, message):
    path = tmp_path / "map.safetensors"
    scene.save(path)
    damage(path, change)
    with pytest.raises(SpslamError, match=f"map.safetensors: damaged map .*{message}") as error:
        Scene.load(path)
    assert "\n" not in str(error.value)


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
