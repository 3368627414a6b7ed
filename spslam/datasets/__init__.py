"""RGB-D sequences: one loader per format, all giving the same frames."""

from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.export import export_folder, import_folder
from spslam.datasets.identify import Identified, identify_recording
from spslam.datasets.prefetch import Prefetcher, prefetch
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
