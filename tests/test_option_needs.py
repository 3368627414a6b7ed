"""Options that have no effect with the others are refused where the user gave them, and old names name the new ones."""

import pytest

from spslam.config import dump_config, load_config, option_paths
from spslam.errors import ConfigError
from spslam.options.faults import RENAMED, describe_unused, option_fields
from spslam.options.needs import needs_of, option_value

ADAM = "tracking.optimizer=adam"


def write(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("config", "preset", "overrides", "message"),
    [
        (
            "7scenes",
            "balanced",
            ["tracking.rotation_rate=0.01"],
            "tracking.rotation_rate is not used with tracking.optimizer=gauss_newton; remove it or set "
            "tracking.optimizer=adam",
        ),
        (
            "7scenes",
            "balanced",
            ["tracking.color_kernel=0.1"],
            "tracking.color_kernel is not used with tracking.color_weight_m=0.0; remove it or set "
            "tracking.color_weight_m above 0",
        ),
        (
            "7scenes",
            "fast",
            ["loss.sdf=10"],
            "loss.sdf is not used with mapping.optimize_geometry=false and mapping.optimize_poses=false and "
            "tracking.optimizer=gauss_newton; remove it or set mapping.optimize_geometry=true or "
            "mapping.optimize_poses=true or tracking.optimizer=adam",
        ),
        (
            "demo",
            None,
            [("dataset.path", "somewhere")],
            "dataset.path (--data) is not used with dataset.type=generated; remove it or set another dataset.type",
        ),
        (
            "tum",
            None,
            ["dataset.sequence=3"],
            "dataset.sequence is not used with dataset.type=tum; remove it or set dataset.type=7scenes",
        ),
        (
            "7scenes",
            "paper",
            ["mapping.iterations=0", "mapping.first_iterations=0", "mapping.pixels=100"],
            "mapping.pixels is not used with mapping.iterations=0 and mapping.first_iterations=0; remove it or set "
            "mapping.iterations above 0 or mapping.first_iterations above 0",
        ),
    ],
)
def test_an_override_without_effect_is_one_clear_line(config, preset, overrides, message):
    with pytest.raises(ConfigError) as caught:
        load_config(config, preset, overrides)
    assert str(caught.value) == message


def test_an_option_of_the_file_is_refused_where_it_has_no_effect(tmp_path):
    path = write(tmp_path, "dataset: {type: tum}\nmapping: {pose_rate: 0.01}\n")
    assert load_config(path, "paper").mapping.pose_rate == 0.01
    with pytest.raises(ConfigError, match="mapping.pose_rate is not used with mapping.optimize_poses=false"):
        load_config(path, "balanced")


def test_so_is_one_of_the_files_section_for_the_preset(tmp_path):
    path = write(tmp_path, "dataset: {type: tum}\npresets: {fast: {mapping: {embedding_rate: 0.01}}}\n")
    load_config(path, "balanced")
    with pytest.raises(ConfigError, match="mapping.embedding_rate is not used with mapping.optimize_geometry=false"):
        load_config(path, "fast")


def test_an_option_has_an_effect_once_what_it_needs_is_set():
    config = load_config("7scenes", overrides=[ADAM, "tracking.rotation_rate=0.01"])
    assert config.tracking.rotation_rate == 0.01


@pytest.mark.parametrize("preset", ["paper", "balanced", "fast"])
def test_a_runs_resolved_configuration_may_hold_options_without_effect(tmp_path, preset):
    config = load_config("7scenes", preset)
    assert describe_unused(config, set(option_paths()))
    path = write(tmp_path, dump_config(config))
    assert load_config(path) == load_config(path, preset) == config


def test_overrides_of_a_resolved_configuration_must_have_an_effect(tmp_path):
    path = write(tmp_path, dump_config(load_config("7scenes")))
    assert load_config(path, overrides=["mapping.every=4"]).mapping.every == 4
    with pytest.raises(ConfigError, match="mapping.pose_rate is not used"):
        load_config(path, overrides=["mapping.pose_rate=0.01"])


@pytest.mark.parametrize(("preset", "overrides"), [("fast", []), (None, ["preset=fast"])])
def test_another_preset_for_a_resolved_configuration_is_refused(tmp_path, preset, overrides):
    path = write(tmp_path, dump_config(load_config("7scenes")))
    with pytest.raises(ConfigError) as caught:
        load_config(path, preset, overrides)
    message = f"preset must be balanced or left out, got fast: {path} holds every option of a run already"
    assert str(caught.value) == message


def test_the_mark_of_a_resolved_configuration_is_true_or_false(tmp_path):
    path = write(tmp_path, "resolved: 3\ndataset: {type: tum}\n")
    with pytest.raises(ConfigError, match="resolved must be true or false, got 3"):
        load_config(path)


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_name_names_the_new_one(tmp_path, old, new):
    value = option_value(load_config("7scenes"), new)
    section, _, key = old.partition(".")
    path = write(tmp_path, f"dataset: {{type: tum}}\n{section}: {{{key}: {str(value).lower()}}}\n")
    for arguments in ((path,), ("7scenes", None, [f"{old}={value}"])):
        with pytest.raises(ConfigError) as caught:
            load_config(*arguments)
        assert str(caught.value) == f"{old} is now called {new}"


def test_old_names_are_none_of_todays():
    assert not set(RENAMED) & set(option_paths())
    assert set(RENAMED.values()) <= set(option_paths())


def test_needs_name_options_that_exist():
    config = load_config("7scenes")
    for _, field in option_fields():
        for need in needs_of(field):
            for condition in need.any_of:
                option_value(config, condition.option)
