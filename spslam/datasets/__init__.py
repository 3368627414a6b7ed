"""RGB-D sequences: one loader per format, all giving the same frames.

The names in `__all__` are imported when they are first used: a run needs one loader of many.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.prefetch import Prefetcher, prefetch

if TYPE_CHECKING:
    from spslam.datasets.export import export_folder, import_folder
    from spslam.datasets.identify import Identified, identify_recording
    from spslam.datasets.registry import dataset_types, open_dataset, open_sequence, sequence_options

__all__ = [
    "Identified",
    "Prefetcher",
    "RgbdDataset",
    "RgbdFrame",
    "Subset",
    "dataset_types",
    "export_folder",
    "identify_recording",
    "import_folder",
    "open_dataset",
    "open_sequence",
    "prefetch",
    "sequence_options",
]

_MODULES = {
    "Identified": "identify",
    "dataset_types": "registry",
    "export_folder": "export",
    "identify_recording": "identify",
    "import_folder": "export",
    "open_dataset": "registry",
    "open_sequence": "registry",
    "sequence_options": "registry",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'spslam.datasets' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"spslam.datasets.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
