"""What a format is to the harness, and all of them by name."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from pathlib import Path
from random import Random

_MODULES = ("tensors", "images", "recordings", "texts", "meshes", "archives")


class Format(ABC):
    """A kind of file or folder, good examples of it, and how spslam reads it.

    Attributes:
        name: what `--format` calls it.
    """

    name: str

    def prepare(self) -> None:  # noqa: B027 - most formats have their examples from the start
        """Makes the good examples, once, before any child is forked."""

    @abstractmethod
    def write(self, random: Random, folder: Path) -> None:
        """Writes a spoiled example into an empty folder."""

    @abstractmethod
    def read(self, folder: Path) -> None:
        """Reads what is in the folder as spslam does, and uses what it got a little."""

    def may_write(self, folder: Path) -> tuple[Path, ...]:
        """Folders that reading may write to; none for most."""
        return ()


def all_formats() -> dict[str, Format]:
    """The formats by name, in the order of the table; not prepared."""
    modules = (importlib.import_module(f"tests.fuzz.targets.{name}") for name in _MODULES)
    return {form.name: form for module in modules for form in module.FORMATS}
