"""The look at the first frames before a run: stops what plainly does not fit together, and reports doubts.

Does not import torch, so that a thread can look while torch is loaded.
"""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from spslam.datasets.base import RgbdDataset
from spslam.datasets.mask import carried_remark
from spslam.datasets.plausibility import Finding, check_first_frames, require_sound
from spslam.datasets.registry import open_sequence
from spslam.run.request import RunRequest
from spslam.run_folder import RunFolder

LOGGER = logging.getLogger("spslam")


class OpenedData:
    """The frames of a run; a thread looks at the first ones as `run.data_check` says.

    Args:
        request: of the run; one that resumes a finished run is not looked at again.

    Raises:
        DatasetError: as of `open_sequence`.

    Attributes:
        dataset: the frames.
        opening_s: how long it took to open them.
    """

    def __init__(self, request: RunRequest) -> None:
        began = time.perf_counter()
        self.dataset: RgbdDataset = open_sequence(request.config.dataset, request.data_dir, request.frames)
        self.opening_s = time.perf_counter() - began
        self._mode = request.config.run.data_check
        self._finds_mask = request.config.dataset.mask is None
        self._findings: Future[list[Finding]] | None = None
        finished = request.resume and RunFolder(Path(request.output_dir)).is_finished
        if self._mode != "skip" and not finished:
            thread = ThreadPoolExecutor(1, "spslam-data-check")
            self._findings = thread.submit(check_first_frames, self.dataset)
            thread.shutdown(wait=False)

    def doubts(self) -> list[str]:
        """Waits for what the first frames show.

        Doubts are also logged as warnings of the logger `spslam`, and so is that something moves along with the camera.

        Returns:
            Doubts, in words; with `run.data_check: warn` also what is certain.

        Raises:
            DatasetError: something is wrong beyond doubt, and `run.data_check` is `stop`.
        """
        findings = [] if self._findings is None else self._findings.result()
        if self._mode == "stop":
            require_sound(findings, self.dataset.name)
        if self._finds_mask and self.dataset.left_out is not None:
            LOGGER.warning("%s: %s", self.dataset.name, carried_remark(self.dataset.left_out))
        for finding in findings:
            LOGGER.warning("%s: %s", self.dataset.name, finding)
        return [str(finding) for finding in findings]
