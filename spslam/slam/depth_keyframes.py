"""Depth and intensity images of earlier frames, with which tracking aligns a frame beside the map."""

from collections.abc import Callable

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.row_copies import RowCopies, write_rows

INTERVAL = 10  # frames between the images that are kept
AGES = (1, 4)  # of the kept images that are used, in intervals
MAX_COLUMNS = 640  # of an image
UNITS = 2**16 - 1  # depth is stored in 16 bits


class DepthKeyframeStore:
    """The last frame's images, and those of every tenth frame while they are used.

    Attributes:
        images: uint16 [S, h, w] depth in units of `unit` m, 0 where unknown; the first is the last frame's.
        intensities: uint8 [S, h, w] in 1/255.
        readouts: float32 [S] by which each was rectified, s; 0 where it is as it was read.
        frames: number of the frame that each image is of, -1 for none.
        unit: m.
        max_depth_m: the largest depth that images hold.
    """

    def __init__(self, camera: Camera, max_depth_m: float, kernel_m: float, device: torch.device | str = "cpu"):
        """A store without images.

        Args:
            camera: of all frames.
            max_depth_m: the largest depth that images hold.
            kernel_m: final width of the robust kernel of distances from the surface in the images.
            device: where the images are.
        """
        self.step = depth_image_step(camera)
        self.unit, self.max_depth_m = depth_unit(max_depth_m), max_depth_m
        self._kernel_m = kernel_m
        slots = 2 + max(AGES)
        self.images = torch.zeros(slots, *depth_image_shape(camera), dtype=torch.uint16, device=device)
        self.intensities = torch.zeros_like(self.images, dtype=torch.uint8)
        self._readout_rows = torch.zeros(slots, 1, dtype=torch.float32, device=device)
        self.readouts = self._readout_rows[:, 0]  # a view
        self._no_readout = torch.zeros(1, dtype=torch.float32, device=device)
        self.frames = [-1] * slots
        self.intrinsics = depth_image_intrinsics(camera)

    def add(
        self,
        frame: int,
        depth: torch.Tensor,
        intensity: torch.Tensor,
        shutter: ops.ShutterMotion | None = None,
        copies: RowCopies | None = None,
    ) -> None:
        """Stores the images of a frame, asynchronously.

        Args:
            frame: its number.
            depth: uint16 [h, w].
            intensity: uint8 [h, w].
            shutter: by which these were rectified; None where they are as they were read.
            copies: all is written when these are made; None writes now.
        """
        readout = self._no_readout if shutter is None else shutter.readout
        for slot in (0,) if frame % INTERVAL else (0, self._slot(frame)):
            columns = [self.images, self.intensities, self._readout_rows]
            write_rows(copies, columns, [slot] * len(columns), [depth, intensity, readout])
            self.frames[slot] = frame

    def select(self, frame: int, is_lost: Callable[[int], bool], poses: torch.Tensor) -> ops.DepthKeyframes | None:
        """Images to align frame number `frame` with: the last frame, one 10 to 19 back and one 40 to 49 back.

        Args:
            frame: its number.
            is_lost: whether the pose of an earlier frame is not trusted, by its number.
            poses: float32 [F, 7] of the frames before; more rows may follow.

        Returns:
            The images of frames with a trusted pose; None if there is none.
        """
        wanted = [(0, frame - 1)]
        for age in AGES:
            kept = (frame // INTERVAL - age) * INTERVAL
            if kept != frame - 1:
                wanted.append((self._slot(kept), kept))
        rows = tuple((slot, of) for slot, of in wanted if of >= 0 and self.frames[slot] == of and not is_lost(of))
        if not rows:
            return None
        return ops.DepthKeyframes(
            self.images, self.unit, poses, rows, self.intrinsics, self._kernel_m, intensities=self.intensities
        )

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs."""
        images = {name: getattr(self, name) for name in ("images", "intensities", "readouts")}
        return {**images, "frames": torch.tensor(self.frames)}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned."""
        for name in ("images", "intensities", "readouts"):
            getattr(self, name).copy_(state[name])
        self.frames = state["frames"].tolist()

    @staticmethod
    def _slot(frame: int) -> int:
        return 1 + frame // INTERVAL % (1 + max(AGES))


def depth_unit(max_depth_m: float) -> float:
    """What a depth image counts depth in, m, where it holds depths up to a largest one."""
    return max_depth_m / UNITS


def depth_image_intrinsics(camera: Camera) -> ops.Intrinsics:
    """Those of a camera's depth and intensity images."""
    step = depth_image_step(camera)
    return ops.Intrinsics(camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step)


def depth_image_shape(camera: Camera) -> tuple[int, int]:
    """Rows and columns of a camera's depth and intensity images."""
    step = depth_image_step(camera)
    return -(-camera.height // step), -(-camera.width // step)


def depth_image_step(camera: Camera) -> int:
    """Every how many pixels of the camera's image a depth image holds one."""
    return -(-camera.width // MAX_COLUMNS)
