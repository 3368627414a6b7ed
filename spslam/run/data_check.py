"""The look at the first frames before a run: stops what plainly does not fit together, and reports doubts."""

from __future__ import annotations

import logging
from pathlib import Path

from spslam.datasets.base import RgbdDataset
from spslam.datasets.plausibility import check_first_frames, require_sound
from spslam.run.request import RunRequest
from spslam.run_folder import RunFolder

LOGGER = logging.getLogger("spslam")


def check_data(request: RunRequest, dataset: RgbdDataset) -> list[str]:
    """Looks at the first frames as `run.data_check` says. Doubts are also logged as warnings of the logger `spslam`.

    Args:
        request: of the run; one that resumes a finished run is not looked at again.
        dataset: its frames.

    Returns:
        Doubts, in words; with `run.data_check: warn` also what is certain.

    Raises:
        DatasetError: something is wrong beyond doubt, and `run.data_check` is `stop`.
    """
    mode, folder = request.config.run.data_check, RunFolder(Path(request.output_dir))
    if mode == "skip" or (request.resume and folder.is_finished):
        return []
    findings = check_first_frames(dataset)
    if mode == "stop":
        require_sound(findings, dataset.name)
    for finding in findings:
        LOGGER.warning("%s: %s", dataset.name, finding)
    return [str(finding) for finding in findings]
