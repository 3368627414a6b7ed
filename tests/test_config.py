"""Configurations: what merges over what, and one line for whatever is wrong."""

import pytest

from spslam.config import config_names, dump_config, load_config, option_paths, resolve_config_path
from spslam.errors import ConfigError
from spslam.options import DATASET_TYPES, PRESETS


def write(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", config_names())
@pytest.mark.parametrize("preset", PRESETS)
def test_shipped_configurations_are_valid_with_every_preset(name, preset):
    config = load_config(name, preset)
    assert config.preset == preset
    assert config.dataset.type in DATASET_TYPES


def test_paper_preset_is_section_iv_a():
    config = load_config("7scenes", "paper")
    assert (config.scene.voxel_size_m, config.scene.plane_cell_m, config.scene.truncation_m) == (0.04, 0.04, 0.08)
    assert (config.sampling.uniform, config.sampling.surface) == (32, 11)
    assert (config.sampling.near, config.sampling.far) == (0.2, 1.02)
    tracking = config.tracking
    assert (tracking.optimizer, tracking.iterations, tracking.first_iterations, tracking.pixels) == ("adam", 6, 6, 1024)
    assert (tracking.rotation_rate, tracking.translation_rate) == (0.001, 0.002)
    mapping = config.mapping
    assert (mapping.every, mapping.iterations, mapping.pixels) == (5, 20, 2048)
    assert (mapping.frames, mapping.recent, mapping.covisible, mapping.covisibility_threshold) == (200, 20, 90, 0.1)
    rates = mapping.embedding_rate, mapping.plane_rate, mapping.decoder_rate, mapping.color_decoder_rate
    assert (*rates, mapping.pose_rate) == (0.004, 0.004, 0.001, 0.001, 0.001)
    loss = config.loss
    assert (loss.rgb, loss.depth, loss.free_space, loss.sdf, loss.cosine_targets) == (10, 0.1, 20, 1000, False)
    assert config.pixels.per_frame == 15000


@pytest.mark.parametrize(("name", "tracking", "mapping"), [("replica", 4, 20), ("tum", 6, 30), ("7scenes", 6, 20)])
def test_paper_iterations_of_each_dataset(name, tracking, mapping):
    config = load_config(name, "paper")
    assert (config.tracking.iterations, config.mapping.iterations) == (tracking, mapping)


def test_later_layers_win(tmp_path):
    path = write(
        tmp_path,
        "preset: fast\ndataset: {type: tum}\nmapping: {iterations: 7}\n"
        "presets:\n  fast: {mapping: {pixels: 512}}\n  paper: {mapping: {pixels: 256}}\n",
    )
    config = load_config(path, overrides=["mapping.every=9", ("dataset.path", "a: b")])
    assert config.preset == "fast"
    assert config.mapping.optimize_geometry is False
    assert (config.mapping.iterations, config.mapping.pixels, config.mapping.every) == (7, 512, 9)
    assert config.dataset.path == "a: b"
    assert load_config(path, "paper").mapping.pixels == 256
    assert load_config(path, overrides=["preset=paper"]).mapping.pixels == 256


def test_exponents_without_a_point_are_numbers():
    assert load_config("7scenes", overrides=["tracking.damping=1e-3"]).tracking.damping == 1e-3


def test_empty_section_changes_nothing(tmp_path):
    for rest in ("tracking:", "presets:", "presets:\n  balanced:"):
        path = write(tmp_path, f"dataset: {{type: replica}}\n{rest}\n")
        assert load_config(path).tracking == load_config("replica").tracking


def test_a_preset_that_is_given_twice():
    assert load_config("replica", "fast", ["preset=fast"]).preset == "fast"
    with pytest.raises(ConfigError, match="preset is given twice: fast and, among changes of options, 'paper'"):
        load_config("replica", "fast", ["preset=paper"])


@pytest.mark.parametrize("preset", PRESETS)
def test_dump_reads_back_equal(tmp_path, preset):
    config = load_config("replica", preset, ["seed=7", ("prior.weights", "some: file.safetensors")])
    path = write(tmp_path, dump_config(config, {"spslam": "0.1.0", "note": "a: b"}))
    assert load_config(path) == config


def test_shipped_configuration_is_found_by_name_and_by_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert resolve_config_path("7scenes") == resolve_config_path("configs/7scenes.yaml")
    (tmp_path / "7scenes").mkdir()
    assert load_config("7scenes").dataset.type == "7scenes"
    (tmp_path / "7scenes.yaml").write_text("dataset: {type: tum}")
    assert load_config("7scenes.yaml").dataset.type == "tum"


def test_configuration_is_immutable():
    with pytest.raises(ValueError, match="frozen"):
        load_config("demo").seed = 3


def test_every_option_has_a_description():
    from spslam.options import Config

    def check(section):
        assert section.__doc__
        for field in section.model_fields.values():
            if hasattr(field.annotation, "model_fields"):
                check(field.annotation)
            else:
                assert field.description
                assert field.is_required(), "numbers live in configs/, not in code"

    check(Config)
    assert len(set(option_paths())) == len(list(option_paths())) > 50


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("tracking.iteratons=3", "tracking.iteratons is not an option; did you mean tracking.iterations?"),
        ("iterations=3", "iterations is not an option; did you mean tracking.iterations?"),
        ("tracking.pose_rate=3", "tracking.pose_rate is not an option; did you mean mapping.pose_rate?"),
        ("foo=3", "foo is not an option; docs/configuration.md lists them all"),
        ("tracking.iterations=0", "tracking.iterations must be at least 1, got 0"),
        ("tracking.iterations=2.5", "tracking.iterations must be a whole number, got 2.5"),
        ("tracking.iterations=abc", "tracking.iterations must be a whole number, got 'abc'"),
        ("tracking.iterations=true", "tracking.iterations must be a whole number, got True"),
        ("tracking=3", "tracking must be a section of options, got 3"),
        ("tracking.optimizer=sgd", "tracking.optimizer must be adam or gauss_newton, got 'sgd'"),
        ("scene.voxel_size_m=0", "scene.voxel_size_m must be above 0, got 0"),
        ("scene.voxel_size_m=null", "scene.voxel_size_m must be a number, got None"),
        ("loss.rgb=.nan", "loss.rgb must be finite, got nan"),
        ("loss.rgb=.inf", "loss.rgb must be finite, got inf"),
        ("prior.enabled=3", "prior.enabled must be true or false, got 3"),
        ("dataset.sequence=[1]", "dataset.sequence must be text, got [1]"),
        ("device=gpu", "device must be auto, cpu, cuda or cuda:N, got 'gpu'"),
        ("mapping.pixels=2000000", "mapping.pixels must be at most 1048576, got 2000000"),
        ("preset=best", "preset must be one of paper, balanced, fast, got 'best'"),
        ("sampling.near=2", "sampling.far must be above sampling.near, got 1.02"),
        ("tracking.kernel_end_m=1", "tracking.kernel_end_m must be at most tracking.kernel_start_m, got 1.0"),
        ("mapping.recent=150", "mapping.frames must be at least mapping.recent + mapping.covisible (240), got 200"),
        ("seed", "--set must be section.key=value, got seed"),
        ("seed=[1", "--set seed:1: must be YAML: expected ',' or ']', but got '<stream end>'"),
    ],
)
def test_wrong_option_is_one_clear_line(override, message):
    with pytest.raises(ConfigError) as caught:
        load_config("7scenes", overrides=[override])
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "dataset.type must be set in the configuration file"),
        ("- 3", "{path}: must contain sections of options, got [3]"),
        ("a: b: c", "{path}:1: must be YAML: mapping values are not allowed here"),
        ("seed: 1\nseed: 2", "{path}:2: must be YAML: seed is given twice"),
        ("{[1]: 2}", "{path}:1: must be YAML: found unhashable key"),
        ("3: 4\ndataset: {type: tum}", "3 is not an option; docs/configuration.md lists them all"),
        ("presets: {papr: {}}", "presets.papr is not an option; it must be one of paper, balanced, fast"),
        ("presets: 3", "presets must be a section of options, got 3"),
        ("dataset: {type: tum, foo: 3}\ntracking: {iterations: 0}", "dataset.foo is not an option; docs/"),
    ],
)
def test_wrong_file_is_one_clear_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(message.format(path=path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("7scene", "7scene: no such configuration; did you mean 7scenes?"),
        ("mine/7scenes.yaml", "mine/7scenes.yaml: no such configuration; did you mean 7scenes?"),
        ("nothing.yaml", "nothing.yaml: no such configuration; shipped are 7scenes, arkitscenes, azure_kinect,"),
        (".", ".: a configuration must be a YAML file, got a folder"),
    ],
)
def test_wrong_path_is_one_clear_line(path, message):
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(message)


def test_binary_file_is_one_clear_line(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="mine.yaml: must be a text file"):
        load_config(path)


ALIASES = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 3000, "must be YAML: it is nested too deep"),
        ("a: " + "{b: " * 3000, "must be YAML: it is nested too deep"),
        (ALIASES, ":2: must be YAML: aliases are not supported"),
        ("seed: &a 3\nmapping: {<<: *a}", ":2: must be YAML: aliases are not supported"),
        ("seed: " + "9" * 5000, ":1: must be YAML: a whole number must have at most 20 digits"),
        ("seed: 0x" + "f" * 5000, ":1: must be YAML: a whole number must have at most 20 digits"),
        ("seed: 1" + ":59" * 100_000, ":1: must be YAML: a whole number must have at most 20 digits"),
        ("seed: !!bool maybe", "must be YAML: malformed"),
        ("seed: !!int ''", "must be YAML: malformed"),
        ("seed: !!timestamp soon", "must be YAML: malformed"),
        ("seed: 0001-01-01 00:00:00 +23:59", "seed must be a whole number, got datetime"),
        ("seed: 99999999999999999999", "seed must be below 9223372036854775808, got 99999999999999999999"),
        ("seed: text", "seed must be a whole number, got 'text'"),
        ("preset: " + "x" * 5000, "preset must be one of paper, balanced, fast, got 'xxx"),
        ("? " + "x" * 5000 + "\n: 1", "xxx[.]{3} is not an option"),
        ("presets: {" + "x" * 500 + ": 1}", "presets.xxxx*[.]{3} is not an option"),
        ("# " + "x" * (1 << 20), "must have at most 1048576 bytes, got 1048578"),
    ],
)
def test_hostile_files_are_one_short_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_config(write(tmp_path, text))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_what_is_no_regular_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="/dev/zero: no such configuration"):
        load_config("/dev/zero")
