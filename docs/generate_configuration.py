"""Writes docs/configuration.md from the options' own descriptions, the defaults and the presets.

Run it from the repository after changing an option; a test fails if the page is out of date.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import yaml

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from spslam.config import config_names  # noqa: E402
from spslam.options import PRESETS, Config, Section  # noqa: E402
from spslam.options.needs import Condition, needs_of  # noqa: E402

HEADER = """# Configuration

<!-- Written by docs/generate_configuration.py; change spslam/options/ or configs/ and run it again. -->

A run's options are merged from four places, each overriding those before:

1. `configs/defaults.yaml`, which has a value for every option,
2. a preset, `--preset paper|balanced|fast`,
3. the configuration file given to `spslam run`, by path or by the name of a shipped one ({names}),
4. `--set section.key=value`, any number of times (and `--device`, `--seed`, `--data` for `device`, `seed` and
   `dataset.path`).

A file may name its `preset`, and under `presets: {{paper: {{...}}}}` set options that apply with that preset only; for
example, `configs/replica.yaml` sets the paper's iterations for Replica and does not change the other presets. Unknown
options, wrong types and values out of range are errors before anything runs. So is an option from a file or `--set`
that has no effect with the other options: "only with" below names the condition. The resolved options of a run are in
its `config.yaml`, marked with `resolved: true`, which can be given to `spslam run` again. Sections and equations in the
tables are those of the paper. The column *default* is of the default preset, `balanced`; what the
[others](#presets) have instead is listed there.

From Python:

```python
from spslam.config import load_config

config = load_config("7scenes", preset="fast", overrides=["mapping.every=4"])
print(config.mapping.every, config.scene.voxel_size_m)
```
"""


def main() -> None:
    """Write the page."""
    (ROOT / "docs" / "configuration.md").write_text(page(), encoding="utf-8")


def page() -> str:
    """The whole page as Markdown."""
    defaults = _load("defaults.yaml")
    presets = {name: _load(f"presets/{name}.yaml") for name in PRESETS}
    parts = [HEADER.format(names=", ".join(f"`{name}`" for name in config_names()))]
    values = _merged(defaults, presets["balanced"])
    parts.append(_section("Options of the whole run", Config, "", values))
    for name, field in Config.model_fields.items():
        if _is_section(field.annotation):
            title = f"`{name}`: {_sentence(field.annotation)}"
            parts.append(_section(title, field.annotation, f"{name}.", values.get(name) or {}))
    parts.append(_preset_table(defaults, presets))
    return "\n".join(parts)


def _section(title: str, section: type[Section], prefix: str, values: dict[str, Any]) -> str:
    rows = ["| option | default | unit | values | meaning |", "|---|---|---|---|---|"]
    for key, field in section.model_fields.items():
        if _is_section(field.annotation):
            continue
        default = _value(values[key]) if key in values else "none, must be given"
        unit = (field.json_schema_extra or {}).get("unit") or ""
        rows.append(f"| `{prefix}{key}` | {default} | {unit} | {_allowed(field)} | {_meaning(field)} |")
    notes = inspect.cleandoc(section.__doc__ or "").partition("\n\n")[2]
    return f"## {title}\n\n" + (f"{notes}\n\n" if notes else "") + "\n".join(rows) + "\n"


def _preset_table(defaults: dict[str, Any], presets: dict[str, dict[str, Any]]) -> str:
    flat = {name: _flatten(values) for name, values in presets.items()}
    base = _flatten(defaults)
    rows = ["| option | " + " | ".join(presets) + " |", "|---" * (len(presets) + 1) + "|"]
    for key, default in base.items():
        values = [flat[name].get(key, default) for name in presets]
        if len({str(value) for value in values}) > 1:
            rows.append(f"| `{key}` | " + " | ".join(_value(value) for value in values) + " |")
    text = (
        "`paper` has the values of section IV.A of the paper; `balanced`, the default, is the most accurate one at the "
        "camera's frame rate; `fast` has the fewest iterations. They differ in:"
    )
    return f"## Presets\n\n{text}\n\n" + "\n".join(rows) + "\n"


def _load(name: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / "configs" / name).read_text(encoding="utf-8")) or {}


def _merged(values: dict[str, Any], others: dict[str, Any]) -> dict[str, Any]:
    both = {key: _merged(values[key], other) for key, other in others.items() if isinstance(other, dict)}
    return values | others | both


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Section)


def _sentence(section: type[Section]) -> str:
    text = (section.__doc__ or "").strip().splitlines()[0].rstrip(".")
    return text[0].lower() + text[1:]


def _value(value: Any) -> str:
    return "`null`" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _meaning(field: Any) -> str:
    needs = [" or ".join(map(_condition, need.any_of)) for need in needs_of(field) if not need.documented_by_section]
    text = field.description + (f"; only with {', and '.join(needs)}" if needs else "")
    return text.replace("|", "\\|")


def _condition(condition: Condition) -> str:
    value = _value(condition.value).strip("`")
    forms = {"=": "`{}={}`", "!=": "`{}` other than `{}`", ">": "`{}` above {}"}
    return forms[condition.relation].format(condition.option, value)


def _allowed(field: Any) -> str:
    limits = {type(limit).__name__: limit for limit in field.metadata}
    parts = [_type(field.annotation)]
    if "Ge" in limits:
        parts.append(f"from {limits['Ge'].ge:.10g}")
    if "Gt" in limits:
        parts.append(f"above {limits['Gt'].gt:.10g}")
    if "Le" in limits:
        parts.append(f"to {limits['Le'].le:.10g}")
    return " ".join(parts)


def _type(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(annotation))
    if get_origin(annotation) is Union or str(annotation).count("|"):
        return " or ".join(_type(member) for member in get_args(annotation))
    names = {int: "whole number", float: "number", bool: "`true`, `false`", str: "text", type(None): "`null`"}
    return names[annotation]


if __name__ == "__main__":
    main()
