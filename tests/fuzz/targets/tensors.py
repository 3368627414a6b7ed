"""Files of tensors: the map, the checkpoint, the prior and the state of a pretraining."""

from __future__ import annotations

import json
import struct
import tempfile
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from random import Random

import numpy as np
import torch

from spslam.datasets.base import RgbdFrame
from spslam.datasets.generated import GeneratedDataset
from spslam.meshing import extract_mesh
from spslam.prior.encoder import load_prior, shipped_weights
from spslam.prior.training import PretrainSettings
from spslam.prior.training_state import TrainingState, load_state, save_state
from spslam.scene import Scene
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.encode_frame import encode_frame
from spslam.slam.system import SlamSystem
from tests.fuzz.formats import Format
from tests.fuzz.structures import TensorFileContent, mutate_tensors
from tests.system.sequences import settings

WIDTH, HEIGHT, FRAMES = 64, 48, 3
CONFIG = settings(
    "scene.voxel_size_m=0.16",
    "scene.truncation_m=0.32",
    "scene.plane_cell_m=0.32",
    "mapping.first_iterations=3",
    "mapping.iterations=2",
    "mapping.every=1",
    "mapping.pixels=128",
    "mapping.reset_moments=false",
    "mapping.optimize_poses=true",
    "mapping.decoder_rate=0.001",
    "pixels.per_frame=256",
    "prior.points_per_frame=256",
    "tracking.iterations=3",
    "tracking.pixels=128",
    "tracking.color_weight_m=0.1",
)
SOURCE = {"data": {"frames": 9}, "next": FRAMES, "clock": {"frames": FRAMES, "wall_s": 0.5, "decode_s": 0.1}}
FILE = "file.safetensors"


class _Examples:
    """A short run, whose map and checkpoint are the good examples."""

    @cached_property
    def frames(self) -> list[RgbdFrame]:
        return list(GeneratedDataset(FRAMES + 1, WIDTH, HEIGHT))

    @cached_property
    def camera(self):
        return GeneratedDataset(1, WIDTH, HEIGHT).camera

    @cached_property
    def system(self) -> SlamSystem:
        system = SlamSystem(CONFIG, self.camera)
        for frame in self.frames[:FRAMES]:
            system.process(frame)
        return system


EXAMPLES = _Examples()


class _TensorFormat(Format):
    """A file whose good example `save` writes."""

    def prepare(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / FILE
            self.save(path)
            self.good = path.read_bytes()
            self.read(Path(folder))

    def write(self, random: Random, folder: Path) -> None:
        (folder / FILE).write_bytes(mutate_tensors(random, self.good))

    def save(self, path: Path) -> None:
        raise NotImplementedError


class Map(_TensorFormat):
    """`map.safetensors`: loaded, asked for distances and colors, and meshed as by `spslam mesh`."""

    name = "map"
    RESOLUTION_M = 0.02
    POINTS = torch.cat(
        [
            torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 4 - 2,
            torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0, 0], [torch.inf, 0, -torch.inf], [1e30, -1e30, 1e9]]),
        ]
    )

    def save(self, path: Path) -> None:
        EXAMPLES.system.state.scene.save(path)

    def write(self, random: Random, folder: Path) -> None:
        content = mutate_tensors(random, self.good)
        kind = random.random()
        if kind < 0.2:
            content = _with_odd_planes(random, self.good)
        elif kind < 0.5:
            content = _with_odd_sizes(random, self.good)
        (folder / FILE).write_bytes(content)

    def read(self, folder: Path) -> None:
        scene = Scene.load(folder / FILE)
        scene.sdf(self.POINTS)
        scene.color(self.POINTS)
        poses = EXAMPLES.system.state.frames.matrices()
        extract_mesh(scene, self.RESOLUTION_M, EXAMPLES.camera, poses)


class Checkpoint(_TensorFormat):
    """`checkpoint.safetensors`: restored, and one more frame tracked and mapped."""

    name = "checkpoint"

    def save(self, path: Path) -> None:
        write_snapshot(path, take_snapshot(EXAMPLES.system.state, CONFIG, SOURCE, copy=False))

    def read(self, folder: Path) -> None:
        system = SlamSystem(CONFIG, EXAMPLES.camera)
        load_checkpoint(folder / FILE, system.state, CONFIG)
        frame = EXAMPLES.frames[FRAMES]
        system.process(RgbdFrame(frame.index, frame.timestamp, frame.color.copy(), frame.depth.copy()))
        system.finish()
        system.trajectory()


class Prior(_TensorFormat):
    """Weights of the encoder and the decoder: loaded, and a frame's points encoded."""

    name = "prior"

    def save(self, path: Path) -> None:
        path.write_bytes(shipped_weights().read_bytes())

    def read(self, folder: Path) -> None:
        prior = load_prior(folder / FILE)
        options = CONFIG.prior.model_copy(update={"neighborhood": prior.neighborhood})
        scene = Scene(EXAMPLES.system.state.scene.settings, 0, geometry_decoder=prior.decoder_params)
        points = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
        normals = torch.nn.functional.normalize(points - 0.5)
        encode_frame(scene.volume, points, normals, prior, options, 0, True)
        scene.sdf(points)


class Pretraining(_TensorFormat):
    """The checkpoint of `spslam pretrain`: loaded, and a step taken."""

    name = "pretraining"
    SETTINGS = json.loads(json.dumps(asdict(PretrainSettings())))

    def save(self, path: Path) -> None:
        parameters = torch.rand(6601, generator=torch.Generator().manual_seed(0))
        state = TrainingState.start(parameters).adam_step(parameters, 1e-3, 0.5)
        save_state(path, state, self.SETTINGS)

    def read(self, folder: Path) -> None:
        state = load_state(folder / FILE, self.SETTINGS)
        state.adam_step(state.parameters, 1e-3, 0.5)


def _with_odd_sizes(random: Random, content: bytes) -> bytes:
    """Lengths that the options allow, and values of the tensors that are finite."""
    parts = TensorFileContent.parse(content)
    voxel_m = random.choice((1.0, 0.5, 0.16, 0.04, 0.001, 1e-6, 1e-30, 1e-310, 10 ** random.uniform(-9, 0)))
    parts.metadata["spslam"]["settings"] |= {
        "voxel_size_m": voxel_m,
        "truncation_m": random.choice((voxel_m, 0.32, 4.0, max(voxel_m, 1e-9))),
        "plane_cell_m": random.choice((0.32, 4.0, 1e-3, 1e-9, 1e-38, 1e-310)),
        "position_scale": random.choice((0.25, 1e-30, 1e30, 1e300)),
    }
    for name, tensor in parts.tensors.items():
        if tensor.dtype in ("F32", "F64") and tensor.content and random.random() < 0.3:
            values = np.frombuffer(tensor.content, {"F32": "<f4", "F64": "<f8"}[tensor.dtype])
            scale = values.dtype.type(
                random.choice((0, 1e-20, 0.1, 10, 1e10, 1e30) if "weights" in name else (-1, 0, 10, 1e30))
            )
            with np.errstate(over="ignore"):
                tensor.content = np.clip(values * scale, -3e38, 3e38).astype(values.dtype).tobytes()
        elif name == "volume.voxel_coords" and random.random() < 0.3:
            rows = len(tensor.content) // 12
            spread = random.choice((2, 8, 100, 2**20))
            coords = {tuple(random.randrange(-spread, spread) for _ in range(3)) for _ in range(rows)}
            while len(coords) < rows:
                coords.add((len(coords), 2**20 - 1, -(2**20)))
            tensor.content = np.array(sorted(coords, key=lambda row: random.random()), "<i4").tobytes()
    return parts.build(random)


def _with_odd_planes(random: Random, content: bytes) -> bytes:
    """Planes that lie elsewhere or have other sizes than the texels, by numbers that add up where they overflow."""
    parts = TensorFileContent.parse(content)
    layout = list(struct.unpack("<15q", parts.tensors["planes.layout"].content))
    rows = parts.tensors["planes.texels"].shape[0]
    for _ in range(random.choice((1, 1, 2))):
        plane = 5 * random.randrange(3)
        match random.randrange(5):
            case 0:
                layout[plane] = random.choice((2**63 - rows, 2**63 - layout[plane + 3] * layout[plane + 4], -rows, 1))
            case 1:
                layout[plane + random.choice((1, 2))] = random.choice(
                    (2**31, -(2**31), 2**32, 2**30, -(2**30), 2**63 - 1)
                )
            case 2:
                layout[plane + 3], layout[plane + 4] = random.choice(
                    ((2**32, 2**32), (2**62, 4), (-1, -rows), (rows, 1), (0, 0))
                )
            case 3:
                layout[plane + 3], layout[plane + 4] = layout[plane + 4], layout[plane + 3]
            case 4:
                layout[plane : plane + 5], layout[:5] = layout[:5], layout[plane : plane + 5]
    values = [(value + 2**63) % 2**64 - 2**63 for value in layout]
    parts.tensors["planes.layout"].content = np.array(values, "<i8").tobytes()
    return parts.build(random)


FORMATS = (Map(), Checkpoint(), Prior(), Pretraining())
