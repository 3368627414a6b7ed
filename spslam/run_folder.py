"""The file names of a run's output folder, in one place.

A run writes these files; evaluation, reports and commands read them.
"""

import re
from dataclasses import dataclass
from pathlib import Path

MESH_FORMATS = ("ply", "glb", "obj")
TEXTURED_FORMATS = ("glb", "obj")  # of those, the ones that a texture fits into

_SEGMENT = re.compile(r"segment-([0-9]+)\.txt")
_COLOR_PREVIEW = re.compile(r"frame-([0-9]{6,})\.png")


@dataclass(frozen=True)
class RunFolder:
    """Paths of the files in a run's output folder; a file need not exist.

    Attributes:
        path: the folder.

    Example:
        >>> RunFolder(Path("runs/demo")).trajectory
        PosixPath('runs/demo/trajectory.txt')
    """

    path: Path

    @property
    def trajectory(self) -> Path:
        """Estimated trajectory in the TUM format."""
        return self.path / "trajectory.txt"

    def segment(self, number: int) -> Path:
        """Trajectory in the TUM format of what a lost camera saw, in axes of its own; `number` is from 1."""
        return self.path / f"segment-{number}.txt"

    def segments(self) -> list[Path]:
        """The files of `segment` that there are, by their numbers."""
        found = {
            int(name[1]): path for path in self.path.glob("segment-*.txt") if (name := _SEGMENT.fullmatch(path.name))
        }
        return [found[number] for number in sorted(found)]

    def trajectory_of(self, recording: int) -> Path:
        """Trajectory of one of the recordings of a merged map, counted from 0; its name counts from 1."""
        return self.path / f"trajectory-{recording + 1}.txt"

    @property
    def map(self) -> Path:
        """The map: sparse volume, feature planes and decoders."""
        return self.path / "map.safetensors"

    @property
    def keyframes(self) -> Path:
        """Keyframes and trajectories, by which the map is opened again; absent without a keyframe graph."""
        return self.path / "keyframes.safetensors"

    @property
    def mesh(self) -> Path:
        """The mesh that a run extracts."""
        return self.mesh_as("ply")

    def mesh_as(self, file_format: str) -> Path:
        """The mesh in one of `MESH_FORMATS`."""
        return self.path / f"mesh.{file_format}"

    def texture_files(self) -> list[Path]:
        """The files that there are beside a mesh.obj with a texture: its materials and their images."""
        return sorted([*self.path.glob("mesh.mtl"), *self.path.glob("mesh-[0-9]*.png")])

    @property
    def metrics(self) -> Path:
        """One JSON object; written when a run has finished."""
        return self.path / "metrics.json"

    @property
    def report(self) -> Path:
        """The report, one HTML file."""
        return self.path / "report.html"

    @property
    def config(self) -> Path:
        """All options of the run; the first file that a run writes."""
        return self.path / "config.yaml"

    @property
    def log(self) -> Path:
        """One JSON object per processed frame."""
        return self.path / "log.jsonl"

    @property
    def skipped(self) -> Path:
        """One JSON object per frame that could not be read; absent where there is none."""
        return self.path / "skipped.jsonl"

    @property
    def checkpoint(self) -> Path:
        """The state to resume from; removed when the run has finished."""
        return self.path / "checkpoint.safetensors"

    @property
    def chunks(self) -> Path:
        """Folder of the runs of chunks, until they are joined."""
        return self.path / "chunks"

    @property
    def chunk_plan(self) -> Path:
        """How the recording is cut into chunks; removed when the run has finished."""
        return self.chunks / "plan.json"

    @property
    def is_finished(self) -> bool:
        """Whether it is of a run that has written all results: there is nothing left to resume."""
        return self.metrics.is_file() and not self.checkpoint.is_file() and not self.chunk_plan.is_file()

    @property
    def previews(self) -> Path:
        """Folder of the input that the report shows: camera, ground truth and some frames."""
        return self.path / "previews"

    @property
    def preview_camera(self) -> Path:
        """Intrinsics of the frames in `previews`, as JSON."""
        return self.previews / "camera.json"

    @property
    def preview_ground_truth(self) -> Path:
        """Ground-truth trajectory in the TUM format; absent where none is known."""
        return self.previews / "ground_truth.txt"

    def color_preview(self, row: int) -> Path:
        """Color image of the frame in a row of the trajectory."""
        return self.previews / f"frame-{row:06d}.png"

    def depth_preview(self, row: int) -> Path:
        """Depth image of the frame in a row of the trajectory, 16 bits, millimeters."""
        return self.previews / f"depth-{row:06d}.png"

    def preview_rows(self) -> list[int]:
        """Rows of the trajectory that have a color preview, ascending."""
        names = (_COLOR_PREVIEW.fullmatch(path.name) for path in self.previews.glob("*.png"))
        return sorted(int(name[1]) for name in names if name)

    def files(self) -> list[Path]:
        """All files that a run or a later command may leave directly in the folder; `previews` is not among them."""
        meshes = [*(self.mesh_as(file_format) for file_format in MESH_FORMATS), *self.texture_files()]
        others = [self.metrics, self.report, self.config, self.log, self.skipped, self.checkpoint]
        return [self.trajectory, *self.segments(), self.map, self.keyframes, *meshes, *others]


def is_merged(folder: RunFolder) -> bool:
    """Whether a folder is of `spslam merge`: it has a trajectory of each recording, and none of its own."""
    return not folder.trajectory.is_file() and folder.trajectory_of(0).is_file()
