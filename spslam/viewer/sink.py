"""Where a run is shown: what the viewer in the browser and the recording for rerun have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from spslam.viewer.model import RunModel

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh
    from spslam.viewer.images import FrameImages

# Of a chunk of the mesh: its place along x, y and z, counted in chunks.
Key = tuple[int, int, int]


class Sink:
    """Does nothing; derive from it. Methods are called from several threads, each from one at a time."""

    def begin(self, model: RunModel) -> None:
        """Before the first frame; the model is the caller's and grows."""

    def show_frames(self) -> None:
        """Frames are new, or have another pose."""

    def show_mesh(self, chunks: Mapping[Key, TriangleMesh | None]) -> None:
        """Chunks of the mesh are new; None where there is no surface any more."""

    def show_images(self, images: FrameImages) -> None:
        """The images of a frame."""

    def is_watched(self) -> bool:
        """Whether anyone sees what is shown now. A recording always is."""
        return True

    def close(self) -> None:
        """After the last frame."""
