"""One line for whatever is wrong with an option."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from pydantic.fields import FieldInfo

from spslam.errors import brief
from spslam.options import Config
from spslam.options.needs import Need, in_yaml, needs_of, option_value
from spslam.options.section import Section

# Names of earlier versions, and what the options are called now.
RENAMED = {
    "tracking.noise_depth_m": "tracking.depth_noise_m",
    "tracking.noise_crossover_depth_m": "tracking.depth_noise_m",
    "tracking.depth_views": "tracking.depth_keyframes",
    "tracking.view_kernel_m": "tracking.depth_keyframe_kernel_m",
    "tracking.rescue": "tracking.recovery",
    "tracking.rescue_below": "tracking.recovery_min_robust_weight",
    "tracking.doubtful_above": "tracking.verify_threshold",
    "tracking.lost_above": "tracking.lost_threshold",
    "tracking.relocalise_below": "tracking.relocalization_threshold",
    "tracking.relocalise_frames": "tracking.relocalization_candidates",
    "tracking.min_valid_share": "tracking.min_valid_depth_share",
}

# Command-line flags of options; messages name them too, as the user may not know the option.
FLAGS = {"dataset.path": "--data"}


def option_fields(section: type[Section] = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """All options as `section.key` with their fields, in the order of `Config`."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from option_fields(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def option_paths() -> Iterator[str]:
    """All options as `section.key`, in the order of `Config`."""
    return (path for path, _ in option_fields())


def describe_unused(config: Config, given: Collection[str]) -> str | None:
    """What is wrong with the first of the given options that has no effect; None where all have one.

    Args:
        config: the whole configuration.
        given: the options that the user gave, as `section.key`.
    """
    for path, field in option_fields():
        missed = next((need for need in needs_of(field) if not need.is_met(config)), None)
        if path in given and missed is not None:
            name = f"{path} ({FLAGS[path]})" if path in FLAGS else path
            return f"{name} is not used with {_actual(config, missed)}; remove it or set {missed}"
    return None


def _actual(config: Config, need: Need) -> str:
    options = dict.fromkeys(condition.option for condition in need.any_of)
    return " and ".join(f"{option}={in_yaml(option_value(config, option))}" for option in options)


def describe_fault(fault: Any) -> str:
    """What is wrong, from an entry of pydantic's `ValidationError.errors()`."""
    path = ".".join(str(part) for part in fault["loc"])
    kind, context, value = fault["type"], fault.get("ctx", {}), fault["input"]
    if kind in ("extra_forbidden", "invalid_key"):
        return _unknown(path)
    if kind == "missing":
        return f"{path} must be set in the configuration file"
    if kind == "value_error":
        return str(context["error"])
    return f"{_option_path(path)} must {_rule(kind, context)}, got {shown(value)}"


def shown(value: Any) -> str:
    """A value of the user as messages show it."""
    return brief(repr(value), 60)


def _unknown(path: str) -> str:
    if path in RENAMED:
        return f"{path} is now called {RENAMED[path]}"
    section, _, key = path.rpartition(".")
    known = list(option_paths())
    siblings = [option.rpartition(".")[2] for option in known if option.rpartition(".")[0] == section]
    near = [f"{section}.{name}".lstrip(".") for name in difflib.get_close_matches(key, siblings, n=1)]
    near = near or [option for option in known if option.rpartition(".")[2] == key]
    # A common section would make any two options alike.
    elsewhere = [option for option in known if option.rpartition(".")[0] != section]
    near = near or difflib.get_close_matches(path, elsewhere, n=1, cutoff=0.8)
    hint = f"did you mean {near[0]}?" if near else "docs/configuration.md lists them all"
    return f"{brief(path)} is not an option; {hint}"


def _option_path(path: str) -> str:
    """The option a fault is in: pydantic appends the member's name to faults in a union."""
    return next((option for option in option_paths() if path.startswith(f"{option}.")), path)


def _rule(kind: str, context: Mapping[str, Any]) -> str:
    rules = {
        "greater_than_equal": "be at least {ge:.10g}",
        "greater_than": "be above {gt:.10g}",
        "less_than_equal": "be at most {le:.10g}",
        "less_than": "be below {lt}",
        "finite_number": "be finite",
        "literal_error": "be {expected}",
        "string_pattern_mismatch": "be auto, cpu, cuda or cuda:N",
        "string_type": "be text",
        "int_type": "be a whole number",
        "int_from_float": "be a whole number",
        "float_type": "be a number",
        "bool_type": "be true or false",
        "model_type": "be a section of options",
    }
    return rules.get(kind, "be valid ({kind})").format(kind=kind, **context).replace("'", "")
