"""Reading a configuration: defaults, then a preset, then a configuration file, then overrides.

A configuration file is YAML with the sections of `spslam.options.Config`. It may name its `preset`, and hold
under `presets: {NAME: ...}` options that apply only with that preset.
"""

from __future__ import annotations

import copy
import difflib
import importlib.resources
import os
import re
from collections.abc import Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pydantic
import yaml

from spslam.errors import ConfigError, brief
from spslam.options import PRESETS, Config
from spslam.options.faults import describe_fault, describe_unused, option_paths, shown
from spslam.reading import MAX_DIGITS, read_text

__all__ = ["Config", "config_names", "dump_config", "load_config", "option_paths", "resolve_config_path"]

Override = str | tuple[str, Any]

# Marks a file that holds every option of a run, also those that have no effect with the others.
RESOLVED = "resolved"
# Of a configuration file; the largest shipped one has 8 kB. PyYAML takes 3 s for 1 MB.
_MAX_BYTES = 1 << 20


def load_config(path: str | os.PathLike, preset: str | None = None, overrides: Iterable[Override] = ()) -> Config:
    """Merges defaults < preset < file < overrides, and checks the result.

    Args:
        path: a YAML file, or the name of a shipped configuration (`7scenes`).
        preset: one of `PRESETS`; None is the file's `preset`, else the default one.
        overrides: `section.key=value` with the value in YAML, or pairs of `section.key` and a value.

    Raises:
        ConfigError: one line that names the option or the file: unknown key, wrong type, value out of range, unreadable
            file, or an option of the file or the overrides that has no effect with the others.
    """
    path = resolve_config_path(path)
    file = _read(path)
    changes = [_parse_override(override) for override in overrides]
    defaults = _read(_config_dir() / "defaults.yaml")
    changed = dict(changes).get("preset")
    if preset is not None and changed not in (None, preset):
        raise ConfigError(f"preset is given twice: {preset} and, among changes of options, {shown(changed)}")
    name = preset or changed or file.get("preset") or defaults["preset"]
    if name not in PRESETS:
        raise ConfigError(f"preset must be one of {', '.join(PRESETS)}, got {shown(name)}")
    is_resolved = _pop_resolved(file, path, name)
    merged = _merge(defaults, _read(_config_dir() / "presets" / f"{name}.yaml"), "")
    given: set[str] = set()
    presets = _preset_section(file.pop("presets", {}), name)
    for layer in (file, presets, *(_nest(key, value) for key, value in changes)):
        merged = _merge(merged, layer, "")
        if layer is not file or not is_resolved:
            given.update(_leaves(layer))
    config = _validate({**merged, "preset": name})
    if fault := describe_unused(config, given):
        raise ConfigError(fault)
    return config


def dump_config(config: Config, header: Mapping[str, Any] | None = None) -> str:
    """The configuration as YAML that `load_config` reads back to an equal one; `header` becomes comments."""
    comments = "".join(f"# {key}: {value}\n" for key, value in (header or {}).items())
    values = {RESOLVED: True, **config.model_dump(mode="json")}
    return comments + yaml.safe_dump(values, sort_keys=False, allow_unicode=True)


def restore_config(values: Mapping[str, Any]) -> Config:
    """The configuration of `Config.model_dump(mode="json")`; raises ConfigError as `load_config`."""
    return _validate(dict(values))


def resolve_config_path(path: str | os.PathLike) -> Path:
    """The file that a path or a shipped configuration's name stands for; `configs/NAME.yaml` is found anywhere."""
    given = Path(path)
    if str(given) in config_names():  # though there may be a folder of that name, say the data's
        return _config_dir() / f"{given}.yaml"
    if given.is_file():
        return given
    if given.is_dir():
        raise ConfigError(f"{given}: a configuration must be a YAML file, got a folder")
    shipped = given.stem if given.suffix in (".yaml", ".yml") else given.name
    if given.parent in (Path(), Path("configs")) and shipped in config_names():
        return _config_dir() / f"{shipped}.yaml"
    if given.parent not in (Path(), Path("configs")) and given.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{given}: no such configuration, file or folder")
    near = difflib.get_close_matches(shipped, config_names(), n=1)
    hint = f"did you mean {near[0]}?" if near else f"shipped are {', '.join(config_names())}"
    raise ConfigError(f"{given}: no such configuration; {hint}")


def read_shipped(name: str) -> dict[str, Any]:
    """The content of a YAML file in the shipped `configs` folder, say `models/pose_confidence.yaml`."""
    return _read(_config_dir() / name)


def config_names() -> list[str]:
    """Names of the shipped configurations."""
    return sorted(path.stem for path in _config_dir().glob("*.yaml") if path.stem != "defaults")


def _config_dir() -> Path:
    package = Path(str(importlib.resources.files("spslam")))
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "defaults.yaml").is_file():
            return folder
    raise ConfigError(f"{package / 'configs'}: the shipped configurations are missing; install spslam again")


class _Loader(yaml.SafeLoader):
    """YAML 1.2's floating-point numbers (`1e-4`), no key twice, no aliases and no whole numbers of any length."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):  # ten levels of ten aliases each stand for 10^10 values
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", mark)
        return super().compose_node(parent, index)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        if len(node.value) > MAX_DIGITS:
            text = f"a whole number must have at most {MAX_DIGITS} digits"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark)
        return super().construct_yaml_int(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                break  # the base class says so
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key} is given twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def _read(path: Path) -> dict[str, Any]:
    content = _parse_yaml(read_text(path, _MAX_BYTES, ConfigError), str(path))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must contain sections of options, got {shown(content)}")
    return content


def _parse_yaml(text: str, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506 (a SafeLoader)
    except RecursionError:
        raise ConfigError(f"{source}: must be YAML: it is nested too deep") from None
    except Exception as error:  # PyYAML's constructors raise whatever a value like `!!bool maybe` makes them raise
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark is not None else source
        raise ConfigError(f"{where}: must be YAML: {getattr(error, 'problem', None) or 'malformed'}") from error


def _parse_override(override: Override) -> tuple[str, Any]:
    if not isinstance(override, str):
        return override
    key, separator, value = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set must be section.key=value, got {override}")
    return key.strip(), _parse_yaml(value, f"--set {key.strip()}")


def _nest(key: str, value: Any) -> dict[str, Any]:
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


def _merge(base: dict[str, Any], change: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A copy of `base` in which `change` replaces values; sections are merged key by key."""
    merged = copy.copy(base)
    for key, value in change.items():
        if isinstance(base.get(key), dict):
            if value is None:  # a section whose lines are all commented out
                continue
            if not isinstance(value, dict):
                raise ConfigError(f"{prefix}{brief(key)} must be a section of options, got {shown(value)}")
            merged[key] = _merge(base[key], value, f"{prefix}{key}.")
        else:
            merged[key] = value
    return merged


def _pop_resolved(file: dict[str, Any], path: Path, preset: str) -> bool:
    """Takes the mark of a resolved configuration off its content; returns whether it was there."""
    is_resolved = file.pop(RESOLVED, False)
    if not isinstance(is_resolved, bool):
        raise ConfigError(f"{RESOLVED} must be true or false, got {shown(is_resolved)}")
    if is_resolved and file.get("preset") != preset:
        raise ConfigError(
            f"preset must be {file.get('preset')} or left out, got {preset}: {path} holds every option of a run already"
        )
    return is_resolved


def _preset_section(presets: Any, name: str) -> dict[str, Any]:
    """Of the file's presets the one in use; one whose lines are all commented out changes nothing."""
    if not isinstance(presets, dict | None):
        raise ConfigError(f"presets must be a section of options, got {shown(presets)}")
    for key, value in (presets or {}).items():
        if key not in PRESETS:
            raise ConfigError(f"presets.{brief(key)} is not an option; it must be one of {', '.join(PRESETS)}")
        if not isinstance(value, dict | None):
            raise ConfigError(f"presets.{key} must be a section of options, got {shown(value)}")
    return (presets or {}).get(name) or {}


def _validate(values: dict[str, Any]) -> Config:
    try:
        return Config.model_validate(values)
    except pydantic.ValidationError as error:
        # Of several faults the unknown key comes first: it is often the cause of the others.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
        raise ConfigError(describe_fault(faults[0])) from None


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """All options of nested sections as `section.key`."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"
