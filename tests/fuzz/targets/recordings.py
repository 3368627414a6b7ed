"""Recordings: `.sens` files, bags, archives, and the lists, poses, intrinsics and images of every layout of folders."""

from __future__ import annotations

import json
import struct
import tempfile
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

from spslam.camera import Camera
from spslam.datasets.inspection import inspect_dataset
from spslam.datasets.lens import Lens
from spslam.datasets.registry import open_dataset, open_sequence
from spslam.datasets.scannet import open_scannet
from spslam.errors import DatasetError
from tests.datasets import layouts, recordings, ros_bags
from tests.fuzz.formats import Format
from tests.fuzz.mutations import any_integer, mutate_bytes, mutate_text, to_bytes
from tests.fuzz.structures import mutate_json

FRAMES = 4
TEXTS = (".txt", ".json", ".csv", ".log", ".traj", ".pincam", ".freiburg", "metadata")


class Sens(Format):
    """`.sens`: bytes, and the fields of its head and of each frame's."""

    name = "sens"
    # Behind a sensor's name of 15 letters: compressions, sizes, depth units, number of frames.
    HEAD = (("<I", 0), ("<Q", 4), *(("<i", 283 + 4 * i) for i in range(6)), ("<f", 307), ("<Q", 311))
    FIRST_FRAME = 319

    def prepare(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            self.good = layouts.write_sens(Path(folder) / "scan.sens", FRAMES).read_bytes()
        raw = layouts.sens_frame(layouts.poses(1)[0], 1, layouts.color_image(0).tobytes(), bytes(2 * 32 * 24))
        self.raw = layouts.sens_head(2, 0, 0) + raw + raw

    def write(self, random: Random, folder: Path) -> None:
        content = random.choice((self.good, self.good, self.raw))
        if random.random() < 0.5:
            content = self._with_other_fields(random, content)
        if random.random() < 0.6:
            content = mutate_bytes(random, content, (self.good, self.raw))
        (folder / "scan.sens").write_bytes(content)

    def _with_other_fields(self, random: Random, content: bytes) -> bytes:
        spoiled = bytearray(content)
        for _ in range(random.choice((1, 1, 2, 3))):
            if random.random() < 0.5:
                form, place = random.choice(self.HEAD)
                bits = 8 * struct.calcsize(form)
                struct.pack_into(form.upper().replace("F", "I"), spoiled, place, any_integer(random, bits, False))
            else:  # times and sizes of the first frame
                place = self.FIRST_FRAME + 64 + 8 * random.randrange(4)
                struct.pack_into("<Q", spoiled, place, any_integer(random, 64, False))
        return bytes(spoiled)

    def read(self, folder: Path) -> None:
        dataset = open_scannet(folder / "scan.sens")
        _read_all(dataset)


class Layout(Format):
    """A folder in one layout, of which one to three files are spoiled, missing or named otherwise."""

    def __init__(self, kind: str, write, images: float = 0.2, **options) -> None:
        self.name = f"folder-{kind}"
        self._images = images
        self._options = SimpleNamespace(type=kind, **options)
        self._write = write
        self._files: dict[str, bytes] = {}

    def prepare(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            root = self._write(Path(folder) / "scene", count=FRAMES)
            self._files = {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        self._files |= self.more_files()

    def more_files(self) -> dict[str, bytes]:
        """Files that the layout may have."""
        if self._options.type == "folder":
            camera = b'{"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24, "depth_scale": 1000}'
            rows = "\n".join(layouts.matrix_text(pose) for pose in layouts.poses(FRAMES))
            return {"intrinsics.json": camera, "poses.txt": rows.encode()}
        if self._options.type == "tum":
            return {"calibration.txt": b"30 31 15.5 11.5 0.1 -0.2 0 0 0.1"}
        return {"TrainSplit.txt": b"sequence1\n"} if self._options.type == "7scenes" else {}

    def write(self, random: Random, folder: Path) -> None:
        files = dict(self._files)
        if self._options.type == "folder":  # both would be refused before anything else is read
            del files["intrinsics.txt" if random.random() < 0.7 else "intrinsics.json"]
        for _ in range(random.choice((1, 1, 1, 2, 3))):
            self._spoil(random, files)
        for name, content in files.items():
            path = folder / "scene" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def _spoil(self, random: Random, files: dict[str, bytes]) -> None:
        wants_text = random.random() >= self._images
        names = [name for name in files if name.endswith(TEXTS) == wants_text] or list(files)
        name = random.choice(names)
        content, kind = files[name], random.random()
        if kind < 0.1:
            del files[name]
        elif kind < 0.15:
            files[_renamed(random, name)] = files.pop(name)
        elif name.endswith(".json") and kind < 0.7:
            files[name] = to_bytes(mutate_json(random, _json(content)))
        elif wants_text:
            files[name] = to_bytes(mutate_text(random, content.decode("utf-8", "surrogateescape")))
        else:
            files[name] = mutate_bytes(random, content, list(files.values()))

    def read(self, folder: Path) -> None:
        self._options.path = str(folder / "scene")
        _read_all(open_sequence(self._options))
        inspect_dataset(open_dataset(self._options), frames=3, pairs=2)


class OneFile(Format):
    """A recording that is one file: its bytes, of one or more good examples."""

    def __init__(self, name: str, kind: str, suffix: str, *writers) -> None:
        self.name, self._suffix = name, suffix
        self._options = SimpleNamespace(type=kind)
        self._writers = writers
        self._examples: list[bytes] = []

    def prepare(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for number, write in enumerate(self._writers):
                self._examples.append(write(Path(folder) / str(number)).read_bytes())

    def write(self, random: Random, folder: Path) -> None:
        content = mutate_bytes(random, random.choice(self._examples), self._examples)
        (folder / f"recording{self._suffix}").write_bytes(content)

    def read(self, folder: Path) -> None:
        self._options.path = str(folder / f"recording{self._suffix}")
        _read_all(open_sequence(self._options))


def _ros1(compression: str | None):
    def write(folder: Path) -> Path:
        make = ros_bags.Messages(False)
        return ros_bags.write_ros1(folder / "a.bag", ros_bags.camera_messages(make, _frames()), make, compression)

    return write


def _realsense(folder: Path) -> Path:
    make = ros_bags.Messages(False)
    return ros_bags.write_ros1(folder / "a.bag", ros_bags.realsense_messages(make, _frames()), make)


def _mcap(folder: Path) -> Path:
    make = ros_bags.Messages(True)
    return ros_bags.write_mcap(folder / "a.mcap", ros_bags.camera_messages(make, _frames(), "compressed"), make)


def _db3(folder: Path) -> Path:
    make = ros_bags.Messages(True)
    folder.mkdir()
    return next(ros_bags.write_ros2(folder / "a", ros_bags.camera_messages(make, _frames()), make).glob("*.db3"))


def _frames() -> ros_bags.Frames:
    lens = Lens(Camera(layouts.WIDTH, layouts.HEIGHT, 30, 31, 15.5, 11.5))
    color, depth = ([draw(i) for i in range(FRAMES)] for draw in (layouts.color_image, layouts.depth_meters))
    return ros_bags.Frames(color, depth, lens, lens, poses=layouts.poses(FRAMES))


def _json(content: bytes) -> Any:
    """The value of a JSON text; another one where it was spoiled before."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return {"camera": [1, {"fx": 3}]}


def _renamed(random: Random, name: str) -> str:
    head, _, last = name.rpartition("/")
    stem, _, suffix = last.partition(".")
    new = random.choice(("", "\u00b2", "\u0662", "9" * 25, "0" * 10 + stem, stem + " ", "." + stem, "-1", "1e5"))
    last = f"{new}.{random.choice((suffix, suffix.upper(), 'png', 'npy'))}"
    return f"{head}/{last if last.strip('.') else 'none'}".lstrip("/")


def _read_all(dataset) -> None:
    """Every frame, and all that is known of them without reading; a frame that can't be read is one that is skipped."""
    dataset.timestamps()
    dataset.poses()
    for index in range(len(dataset)):
        try:
            dataset[index]
        except DatasetError as error:
            if "\n" in str(error):
                raise


FORMATS = (
    Sens(),
    Layout("tum", layouts.write_tum),
    Layout("7scenes", layouts.write_seven_scenes),
    Layout("replica", layouts.write_replica),
    Layout("synthetic_rgbd", layouts.write_synthetic_rgbd),
    Layout("scannet", layouts.write_scannet),
    Layout("folder", layouts.write_folder),
    Layout("stray_scanner", recordings.write_stray_scanner, min_confidence=1),
    Layout("record3d", recordings.write_record3d_folder, min_confidence=1),
    Layout("scannetpp", recordings.write_scannetpp),
    Layout("arkitscenes", recordings.write_arkitscenes, min_confidence=1),
    Layout("open3d", recordings.write_open3d),
    Layout("icl_nuim", recordings.write_icl_nuim),
    Layout("video", recordings.write_video_recording),
    OneFile("r3d", "record3d", ".r3d", recordings.write_record3d),
    OneFile("ros1", "rosbag", ".bag", _ros1(None), _ros1("LZ4")),
    OneFile("realsense", "realsense", ".bag", _realsense),
    OneFile("mcap", "rosbag", ".mcap", _mcap),
    OneFile("db3", "rosbag", ".db3", _db3),
)
