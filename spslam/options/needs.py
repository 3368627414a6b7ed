"""What other options must be for an option to have an effect.

An option that has no effect in a run is an error where the user gave it. Defaults and presets may hold such options.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

from pydantic import BaseModel
from pydantic.fields import FieldInfo


@dataclass(frozen=True)
class Condition:
    """What one option must be, such as `tracking.optimizer=adam`.

    Attributes:
        option: as `section.key`.
        relation: between the option's value and `value`.
        value: what it is compared with.
    """

    option: str
    relation: Literal["=", "!=", ">"]
    value: Any

    def __str__(self) -> str:
        if self.relation == "!=":
            return f"another {self.option}"
        return f"{self.option}={in_yaml(self.value)}" if self.relation == "=" else f"{self.option} above {self.value}"

    def holds(self, config: BaseModel) -> bool:
        """Whether the condition holds for a configuration."""
        actual = option_value(config, self.option)
        if self.relation == ">":
            return actual > self.value
        return (actual == self.value) == (self.relation == "=")


@dataclass(frozen=True)
class Need:
    """Conditions of which at least one must hold.

    Attributes:
        any_of: the conditions.
        documented_by_section: whether the section's docstring says so, and not each of its options.
    """

    any_of: tuple[Condition, ...]
    documented_by_section: bool = False

    def __str__(self) -> str:
        return " or ".join(str(condition) for condition in self.any_of)

    def is_met(self, config: BaseModel) -> bool:
        """Whether one of the conditions holds for a whole configuration."""
        return any(condition.holds(config) for condition in self.any_of)


def is_(option: str, value: Any) -> Condition:
    """The option must have this value."""
    return Condition(option, "=", value)


def is_not(option: str, value: Any) -> Condition:
    """The option must have another value."""
    return Condition(option, "!=", value)


def above(option: str, value: float) -> Condition:
    """The option must be greater."""
    return Condition(option, ">", value)


def need(*any_of: Condition) -> Need:
    """At least one of the conditions."""
    return Need(any_of)


def needs_of(field: FieldInfo) -> tuple[Need, ...]:
    """The needs of an option, each of which must be met; empty where it always has an effect."""
    return cast(dict, field.json_schema_extra)["needs"]


def option_value(config: BaseModel, path: str) -> Any:
    """The value of `section.key`."""
    value: Any = config
    for part in path.split("."):
        value = getattr(value, part)
    return value


def in_yaml(value: Any) -> str:
    """The value as a configuration file would have it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
