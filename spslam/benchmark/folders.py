"""Where a machine has the sequences of the suites, if not in the folders that the datasets use themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from spslam.benchmark.suites import Suite, load_suite, suite_names
from spslam.errors import ConfigError

Folders = dict[str, dict[str, str]]


def read_folders(path: Path) -> Folders:
    """Reads a YAML file that names folders of sequences::

        quick: {kitchen: recordings/kitchen, rpy: recordings/fr1_rpy}
        7scenes: {redkitchen: recordings/kitchen}

    Args:
        path: the file.

    Returns:
        Folder by suite and sequence, relative to the folder of all datasets, or absolute.

    Raises:
        ConfigError: the file can't be read, or names a suite or sequence that doesn't exist or needs no data.
    """
    content = _read(path)
    for suite, folders in content.items():
        if suite not in suite_names():
            raise ConfigError(f"{path}: suite must be one of {', '.join(suite_names())}, got {suite}")
        if not isinstance(folders, dict):
            raise ConfigError(f"{path}: {suite} must contain SEQUENCE: FOLDER, got {folders}")
        known = [sequence.name for sequence in load_suite(suite).studies[0].sequences if sequence.folders]
        for name, folder in folders.items():
            if name not in known:
                raise ConfigError(f"{path}: a sequence of {suite} must be one of {', '.join(known)}, got {name}")
            if not isinstance(folder, str):
                raise ConfigError(f"{path}: the folder of {suite}, {name} must be text, got {folder}")
    return content


def _read(path: Path) -> dict[Any, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"{path}: can't be read: {reason}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: must be YAML: {getattr(error, 'problem', None) or 'malformed'}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must contain SUITE: {{SEQUENCE: FOLDER}}, got {content}")
    return content


def with_folders(suite: Suite, folders: Folders) -> Suite:
    """The suite, with its sequences in the given folders; those not mentioned stay where they are."""
    chosen: Mapping[str, str] = folders.get(suite.name, {})
    return replace(
        suite,
        studies=tuple(
            replace(
                study,
                sequences=tuple(
                    replace(sequence, folders=(chosen[sequence.name],)) if sequence.name in chosen else sequence
                    for sequence in study.sequences
                ),
            )
            for study in suite.studies
        ),
    )
