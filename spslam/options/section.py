"""What all sections of options share."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from spslam.options.needs import Need


def option(description: str, unit: str | None = None, needs: tuple[Need, ...] = (), **limits: Any) -> Any:
    """The field of an option.

    Args:
        description: what the option does.
        unit: of its value.
        needs: what other options must be for this one to have an effect: at least one condition of each need.
        **limits: of its value, as pydantic's `Field` takes them.
    """
    extra: dict[str, Any] = {"unit": unit, "needs": needs}
    return Field(description=description, json_schema_extra=extra, **limits)


class Section(BaseModel):
    """A group of options: immutable, complete, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _check(self) -> Section:
        self.check()
        return self

    def check(self) -> None:
        """Raise ValueError where options that are valid one by one don't go together."""
