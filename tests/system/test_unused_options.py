"""Options that `spslam.options` says have no effect with others have none, whatever their values."""

import pytest
import torch

from spslam.config import Config, load_config
from spslam.options import PRESETS
from spslam.options.faults import option_fields
from spslam.options.needs import needs_of, option_value
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded

FRAMES = 6
SMALL = ("mapping.every=2", "mapping.iterations=2", "mapping.first_iterations=6", "mapping.pixels=256")
NO_MAPPING = ("mapping.iterations=0", "mapping.first_iterations=0", "mapping.every=2")
SITUATIONS = {
    "balanced": ("balanced", SMALL),
    "fast": ("fast", (*SMALL, "tracking.depth_keyframes=false")),
    "adam without recovery": (
        "paper",
        (*SMALL, "tracking.recovery=false", "tracking.relocalization_candidates=0", "tracking.first_frames=0"),
    ),
    "nothing optimized": ("balanced", NO_MAPPING),
    "no prior": ("paper", (*SMALL, "prior.enabled=false", "prior.decoder=random")),
    "surface samples, no color": ("balanced", (*SMALL, "sampling.uniform=0", "loss.rgb=0", "mapping.covisible=0")),
}
OTHER_WORDS = {"run.graph_solver": "process"}
# What only the reading of data takes is told by the dataset's type; weights are read wherever they are given.
NOT_TESTED_HERE = {path for path, _ in option_fields() if path.startswith("dataset.")} | {"prior.weights"}


def unused(config: Config) -> list[str]:
    fields = [(path, needs_of(field)) for path, field in option_fields() if path not in NOT_TESTED_HERE]
    return [path for path, needs in fields if not all(need.is_met(config) for need in needs)]


def with_other_values(config: Config, paths: list[str]) -> Config:
    """The configuration, with other values of some options; not checked, as a user's would be."""
    for path in paths:
        section, _, key = path.partition(".")
        value = option_value(config, path)
        if isinstance(value, str):
            other = OTHER_WORDS[path]
        else:
            other = not value if isinstance(value, bool) else value + 3 if isinstance(value, int) else 2 * value + 0.01
        changed = getattr(config, section).model_copy(update={key: other})
        config = config.model_copy(update={section: changed})
    return config


def outcome(config: Config) -> list[torch.Tensor]:
    dataset = Recorded(FRAMES)
    system = SlamSystem(config, dataset.camera)
    for frame in dataset:
        system.process(frame)
    system.finish()
    return [system.state.frames.poses, *system.state.scene.state_dict().values()]


@pytest.mark.parametrize(
    "name", [name if name in PRESETS else pytest.param(name, marks=pytest.mark.slow) for name in SITUATIONS]
)
def test_options_without_effect_change_nothing(name):
    preset, overrides = SITUATIONS[name]
    config = load_config("demo", preset, overrides)
    before, after = outcome(config), outcome(with_other_values(config, unused(config)))
    assert all(a.equal(b) for a, b in zip(before, after, strict=True))


def test_every_option_with_needs_is_covered():
    covered = {
        path for preset, overrides in SITUATIONS.values() for path in unused(load_config("demo", preset, overrides))
    }
    assert covered == {path for path, field in option_fields() if needs_of(field)} - NOT_TESTED_HERE
