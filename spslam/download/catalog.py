"""Catalog of public datasets: their URLs and licenses."""

from __future__ import annotations

import difflib
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from spslam.errors import DatasetError

_SEVEN_SCENES = "https://download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"
_TUM = "https://cvg.cit.tum.de/rgbd/dataset"
_REPLICA = "https://cvg-data.inf.ethz.ch/nice-slam"
_NEURAL_RGBD = "http://kaldir.vc.in.tum.de/neural_rgbd"
_TUM_NAME = re.compile(r"(?:rgbd_dataset_)?freiburg([123])_(\w+)")
_TUM_SHORT = {
    "fr1_desk": "freiburg1_desk",
    "fr2_xyz": "freiburg2_xyz",
    "fr3_office": "freiburg3_long_office_household",
}
_SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
SCANNET_TERMS = (
    "scannet can't be downloaded without signing its terms of use at http://www.scan-net.org; its authors then send a "
    "download script; fetch scans with it (--type .sens) and run: spslam run scannet --data SCAN"
)


@dataclass(frozen=True)
class Archive:
    """An archive file to download.

    Attributes:
        url: where it is; the last part is the file name.
        folder: where it is unpacked, below the data folder.
        sha256: its checksum where the publisher gives one; with None only the checksums inside the archive are checked.
    """

    url: str
    folder: str = "."
    sha256: str | None = None

    @property
    def name(self) -> str:
        """The file name."""
        return self.url.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class Source:
    """A dataset, or a part of one, that can be downloaded by name.

    Attributes:
        name: name on the command line.
        title: one-line description.
        terms: its license, and the page that states it.
        gigabytes: approximate size of the download, in GB.
        archives: files to download.
        config: name of the configuration that reads it.
        folder: of one sequence, relative to the data folder.
    """

    name: str
    title: str
    terms: str
    gigabytes: float
    archives: tuple[Archive, ...]
    config: str
    folder: str

    def run_command(self, spslam: str, data: Path) -> str:
        """The command line that runs on a sequence of it; `spslam` is how the command is called."""
        return f"{spslam} run {self.config} --data {shlex.quote(str(data / self.folder))}"


def find_source(name: str) -> Source:
    """Looks up a source by name: one of `SOURCES`, or any sequence of TUM RGB-D as `tum/freiburg1_rpy`.

    Raises:
        DatasetError: an unknown name, with a suggestion, or ScanNet, whose terms of use must be signed first.
    """
    if name.partition("/")[0] == "scannet":
        raise DatasetError(SCANNET_TERMS)
    known = {source.name: source for source in SOURCES}
    if name in known:
        return known[name]
    sequence = _TUM_NAME.fullmatch(name.removeprefix("tum/"))
    if name.startswith("tum/") and sequence is not None:
        return _tum(name, f"freiburg{sequence.group(1)}_{sequence.group(2)}")
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else "`spslam download` lists the names"
    raise DatasetError(f"{name}: not a dataset that can be downloaded; {hint}")


def _tum(name: str, sequence: str) -> Source:
    folder = f"rgbd_dataset_{sequence}"
    return Source(
        name,
        f"TUM RGB-D, {sequence}",
        "CC BY 4.0; https://cvg.cit.tum.de/data/datasets/rgbd-dataset",
        1.5,
        (Archive(f"{_TUM}/{sequence.partition('_')[0]}/{folder}.tgz", "tum"),),
        "tum",
        f"tum/{folder}",
    )


def _seven_scenes(scene: str) -> Source:
    return Source(
        f"7scenes/{scene}",
        f"7-Scenes, {scene}",
        "Microsoft Research license, research use only; "
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes",
        3.0,
        (Archive(f"{_SEVEN_SCENES}/{scene}.zip", "7scenes"),),
        "7scenes",
        f"7scenes/{scene}",
    )


SOURCES: tuple[Source, ...] = (
    Source(
        "replica",
        "Replica, the eight rooms rendered for NICE-SLAM, with ground-truth meshes",
        "Replica research terms, no commercial use; https://github.com/facebookresearch/Replica-Dataset",
        12.4,
        (Archive(f"{_REPLICA}/data/Replica.zip"), Archive(f"{_REPLICA}/cull_replica_mesh.zip")),
        "replica",
        "Replica/room0",
    ),
    Source(
        "synthetic_rgbd",
        "Synthetic RGB-D (Neural RGB-D), its rooms with culled ground-truth meshes",
        "CC-BY or CC-0, by scene; https://github.com/dazinovic/neural-rgbd-surface-reconstruction",
        7.5,
        (Archive(f"{_NEURAL_RGBD}/neural_rgbd_data.zip"), Archive(f"{_NEURAL_RGBD}/meshes.zip")),
        "synthetic_rgbd",
        "neural_rgbd_data/grey_white_room",
    ),
    *(_tum(f"tum/{name}", sequence) for name, sequence in _TUM_SHORT.items()),
    *(_seven_scenes(scene) for scene in _SCENES),
)
