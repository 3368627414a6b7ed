"""Reading a configuration: defaults, then a preset, then a configuration file, then overrides.

A configuration file is YAML with the sections of :class:`spslam.options.Config`. It may name its ``preset``, and hold
under ``presets: {NAME: ...}`` options that apply only with that preset.
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
from spslam.options import PRESETS, Config, Section
from spslam.reading import MAX_DIGITS, read_text

__all__ = ["Config", "config_names", "dump_config", "load_config", "option_paths", "resolve_config_path"]

Override = str | tuple[str, Any]

# Of a configuration file; the largest shipped one has 8 kB. PyYAML takes 3 s for 1 MB.
_MAX_BYTES = 1 << 20


def load_config(path: str | os.PathLike, preset: str | None = None, overrides: Iterable[Override] = ()) -> Config:
    """Merge defaults < preset < file < overrides, and check the result.

    Parameters
    ----------
    path : a YAML file, or the name of a shipped configuration (``7scenes``).
    preset : one of ``PRESETS``; None is the file's ``preset``, else the default one.
    overrides : ``section.key=value`` with the value in YAML, or pairs of ``section.key`` and a value.

    Raises
    ------
    ConfigError
        One line that names the option or the file: unknown key, wrong type, value out of range, unreadable file.
    """
    path = resolve_config_path(path)
    file = _read(path)
    changes = [_parse_override(override) for override in overrides]
    defaults = _read(_config_dir() / "defaults.yaml")
    name = preset or dict(changes).get("preset") or file.get("preset") or defaults["preset"]
    if name not in PRESETS:
        raise ConfigError(f"preset must be one of {', '.join(PRESETS)}, got {_shown(name)}")
    merged = _merge(defaults, _read(_config_dir() / "presets" / f"{name}.yaml"), "")
    merged = _merge(merged, file, "")
    merged = _merge(merged, _preset_section(merged.pop("presets", {}), name), "")
    for key, value in changes:
        merged = _merge(merged, _nest(key, value), "")
    return _validate({**merged, "preset": name})


def dump_config(config: Config, header: Mapping[str, Any] | None = None) -> str:
    """The configuration as YAML that :func:`load_config` reads back to an equal one; ``header`` becomes comments."""
    comments = "".join(f"# {key}: {value}\n" for key, value in (header or {}).items())
    return comments + yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def resolve_config_path(path: str | os.PathLike) -> Path:
    """The file that a path or a shipped configuration's name stands for; ``configs/NAME.yaml`` is found anywhere."""
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
    near = difflib.get_close_matches(shipped, config_names(), n=1)
    hint = f"did you mean {near[0]}?" if near else f"shipped are {', '.join(config_names())}"
    raise ConfigError(f"{given}: no such configuration; {hint}")


def config_names() -> list[str]:
    """Names of the shipped configurations."""
    return sorted(path.stem for path in _config_dir().glob("*.yaml") if path.stem != "defaults")


def option_paths(section: type[Section] = Config, prefix: str = "") -> Iterator[str]:
    """All options as ``section.key``, in the order of :class:`spslam.options.Config`."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from option_paths(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name


def _config_dir() -> Path:
    package = Path(str(importlib.resources.files("spslam")))
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "defaults.yaml").is_file():
            return folder
    raise ConfigError(f"{package / 'configs'}: the shipped configurations are missing; install spslam again")


class _Loader(yaml.SafeLoader):
    """YAML 1.2's floating-point numbers (``1e-4``), no key twice, no aliases and no whole numbers of any length."""

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
        raise ConfigError(f"{path}: must hold sections of options, got {_shown(content)}")
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
    """A copy of ``base`` in which ``change`` replaces values; sections are merged key by key."""
    merged = copy.copy(base)
    for key, value in change.items():
        if isinstance(base.get(key), dict):
            if value is None:  # a section whose lines are all commented out
                continue
            if not isinstance(value, dict):
                raise ConfigError(f"{prefix}{brief(key)} must be a section of options, got {_shown(value)}")
            merged[key] = _merge(base[key], value, f"{prefix}{key}.")
        else:
            merged[key] = value
    return merged


def _preset_section(presets: Any, name: str) -> dict[str, Any]:
    if not isinstance(presets, dict):
        raise ConfigError(f"presets must be a section of options, got {_shown(presets)}")
    for key, value in presets.items():
        if key not in PRESETS:
            raise ConfigError(f"presets.{brief(key)} is not an option; it must be one of {', '.join(PRESETS)}")
        if not isinstance(value, dict):
            raise ConfigError(f"presets.{key} must be a section of options, got {_shown(value)}")
    return presets.get(name, {})


def _validate(values: dict[str, Any]) -> Config:
    try:
        return Config.model_validate(values)
    except pydantic.ValidationError as error:
        # Of several faults the unknown key comes first: it is often the cause of the others.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
        raise ConfigError(_describe(faults[0])) from None


def _describe(fault: Any) -> str:
    path = ".".join(str(part) for part in fault["loc"])
    kind, context, value = fault["type"], fault.get("ctx", {}), fault["input"]
    if kind in ("extra_forbidden", "invalid_key"):
        return _unknown(path)
    if kind == "missing":
        return f"{path} must be given; the configuration file has to say it"
    if kind == "value_error":
        return str(context["error"])
    return f"{_option_path(path)} must {_rule(kind, context)}, got {_shown(value)}"


def _unknown(path: str) -> str:
    section, _, key = path.rpartition(".")
    known = list(option_paths())
    siblings = [option.rpartition(".")[2] for option in known if option.rpartition(".")[0] == section]
    near = [f"{section}.{name}".lstrip(".") for name in difflib.get_close_matches(key, siblings, n=1)]
    near = near or [option for option in known if option.rpartition(".")[2] == key]
    near = near or difflib.get_close_matches(path, known, n=1, cutoff=0.8)
    hint = f"did you mean {near[0]}?" if near else "docs/configuration.md lists them all"
    return f"{brief(path)} is not an option; {hint}"


def _option_path(path: str) -> str:
    """The option a fault is in: pydantic appends the member's name to faults in a union."""
    return next((option for option in option_paths() if path.startswith(f"{option}.")), path)


def _rule(kind: str, context: Mapping[str, Any]) -> str:
    rules = {
        "greater_than_equal": "be at least {ge:g}",
        "greater_than": "be above {gt:g}",
        "less_than_equal": "be at most {le:g}",
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


def _shown(value: Any) -> str:
    return brief(repr(value), 60)
