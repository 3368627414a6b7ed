"""Texts outside recordings: trajectories, configurations, and the JSON of a finished run's folder."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import yaml

from spslam.camera import Camera
from spslam.config import dump_config, load_config
from spslam.evaluation.finished_run import trajectory_figures
from spslam.evaluation.run_output import RunOutput
from spslam.trajectory import Trajectory
from tests.datasets.layouts import color_image, depth_meters, poses, write_color, write_depth
from tests.fuzz.formats import Format
from tests.fuzz.mutations import mutate_bytes, mutate_text, to_bytes
from tests.fuzz.structures import mutate_json, mutate_value

FRAMES = 6


def trajectory_text() -> str:
    """A trajectory in the TUM format, with a lost frame."""
    with tempfile.TemporaryDirectory() as folder:
        lost = [False, False, True, False, False, False]
        Trajectory(np.arange(FRAMES) / 30, poses(FRAMES), lost).save_tum(Path(folder) / "t.txt")
        return (Path(folder) / "t.txt").read_text()


class TrajectoryText(Format):
    """A trajectory file by itself."""

    name = "trajectory"

    def prepare(self) -> None:
        self.good = trajectory_text()

    def write(self, random: Random, folder: Path) -> None:
        (folder / "t.txt").write_bytes(to_bytes(mutate_text(random, self.good)))

    def read(self, folder: Path) -> None:
        for skip_unknown in (False, True):
            trajectory = Trajectory.load_tum(folder / "t.txt", skip_unknown)
            assert np.isfinite(trajectory.poses).all()


class Yaml(Format):
    """A configuration: other values, other keys, tags and anchors, and its text."""

    name = "yaml"
    TAGS = ("!!bool", "!!int", "!!float", "!!timestamp", "!!binary", "!!set", "!!omap", "!!pairs", "!!merge", "!!null")
    TAGS += (
        "!!python/object/apply:os.system",
        "!!str",
        "&a",
        "*a",
        "<<: *a",
        "|",
        ">",
        "? ",
        "- ",
        "%TAG ! x",
        "---",
        "...",
    )

    def prepare(self) -> None:
        self.good = yaml.safe_load(dump_config(load_config("7scenes", "paper")))

    def write(self, random: Random, folder: Path) -> None:
        kind = random.random()
        value = mutate_value(random, self.good) if kind < 0.8 else self.good
        try:
            text = yaml.safe_dump(value, sort_keys=False, allow_unicode=random.random() < 0.5)
        except (yaml.YAMLError, UnicodeError, ValueError):
            text = json.dumps(value)
        if kind > 0.6:
            text = mutate_text(random, text)
        if kind > 0.7:
            place = random.choice([i for i, character in enumerate(text) if character in " \n"] or [0])
            inserted = random.choice((*self.TAGS, *("[" * n for n in (10, 3000)), *("{a: " * n for n in (10, 3000))))
            text = f"{text[:place]} {inserted} {text[place:]}"
        (folder / "c.yaml").write_bytes(to_bytes(text))

    def read(self, folder: Path) -> None:
        config = load_config(folder / "c.yaml")
        dump_config(config)


class RunFolder(Format):
    """What `spslam eval` reads of a finished run: metrics, log, trajectories, camera and previews."""

    name = "run-folder"

    def prepare(self) -> None:
        log = [{"frame": i, "index": i, "timestamp": i / 30, "tracking_ms": 1.5, "lost": i == 2} for i in range(FRAMES)]
        self.values: dict[str, Any] = {
            "metrics.json": {"version": "1", "frames": FRAMES, "ate_rmse_cm": 1.5, "seed": 0, "device_name": "cpu"},
            "previews/camera.json": vars(Camera(32, 24, 30, 31, 15.5, 11.5)),
        }
        text = trajectory_text()
        truth = "\n".join(line for line in text.splitlines() if not line.startswith("#")) + "\n"
        self.texts = {"trajectory.txt": text, "previews/ground_truth.txt": truth, "config.yaml": "seed: 0\n"}
        self.texts["log.jsonl"] = "".join(json.dumps(line) + "\n" for line in log)
        with tempfile.TemporaryDirectory() as folder:
            write_color(Path(folder) / "frame-000001.png", color_image(0))
            write_depth(Path(folder) / "depth-000001.png", depth_meters(0))
            self.images = {f"previews/{path.name}": path.read_bytes() for path in Path(folder).iterdir()}

    def write(self, random: Random, folder: Path) -> None:
        spoiled = random.sample([*self.values, *self.texts, *self.images], random.choice((1, 1, 2, 3)))
        contents = {name: json.dumps(value).encode() for name, value in self.values.items()}
        contents |= {name: text.encode() for name, text in self.texts.items()} | self.images
        for name in spoiled:
            if name in self.values:
                contents[name] = to_bytes(mutate_json(random, self.values[name]))
            elif name in self.texts:
                contents[name] = to_bytes(mutate_text(random, self.texts[name]))
            else:
                contents[name] = mutate_bytes(random, self.images[name])
        for name, content in contents.items():
            path = folder / "run" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def read(self, folder: Path) -> None:
        run = RunOutput.read(folder / "run")
        run.previews()
        trajectory_figures(run, with_scale=True)


FORMATS = (TrajectoryText(), Yaml(), RunFolder())
