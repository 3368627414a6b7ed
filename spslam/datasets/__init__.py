"""RGB-D sequences: one loader per format, all giving the same frames."""

from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.export import export_folder
from spslam.datasets.prefetch import Prefetcher, prefetch
from spslam.datasets.registry import dataset_types, open_dataset, open_sequence, sequence_options

__all__ = [
    "Prefetcher",
    "RgbdDataset",
    "RgbdFrame",
    "Subset",
    "dataset_types",
    "export_folder",
    "open_dataset",
    "open_sequence",
    "prefetch",
    "sequence_options",
]
