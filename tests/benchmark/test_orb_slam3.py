"""ORB-SLAM3 as a baseline: by a stand-in for its library, and where it is installed by the library itself."""

import os
import re
import sys

import numpy as np
import pytest

from spslam.benchmark.jobs import make_plan
from spslam.benchmark.measure import measure
from spslam.benchmark.orb_slam3 import VOCABULARY, OrbSlam3, orb_slam3_off_reason, orb_slam3_settings
from spslam.benchmark.records import run_jobs
from spslam.benchmark.suites import ORB_SLAM3, load_suite
from spslam.camera import Camera
from spslam.errors import SpslamError
from spslam.tasks.local import LocalExecutor
from tests.benchmark.examples import tiny_job
from tests.system.sequences import Recorded

# The fixtures of all tests here take the variable away.
REAL_VOCABULARY = os.environ.get(VOCABULARY)
RATE_HZ = 30.0
# Of the library itself on 60 frames of the arcade. Measured: 1.1 to 1.4 cm, all frames tracked.
ATE_CM, TRACKED = 4.0, 50


def job(**changes):
    values = {"options": (("dataset.width", 120), ("dataset.height", 90)), "preset": None, "method_options": ()}
    return tiny_job(ORB_SLAM3, **{**values, **changes})


def run(dataset):
    with OrbSlam3(dataset.camera, RATE_HZ) as slam:
        for frame in dataset:
            slam.process(frame)
        return slam.live, slam.finish()


def test_live_and_final_trajectory(fake_orb_slam3):
    dataset = Recorded(5, lambda frame: frame.depth.fill(0) if frame.index == 2 else None)
    live, final = run(dataset)
    assert [pose is None for pose in live] == [False, False, True, False, False]
    assert [pose is None for pose in final] == [False, False, True, False, True]
    times = dataset.timestamps() - dataset.timestamps()[0]
    np.testing.assert_allclose(live[3][:3, 3], [times[3], 0, 0], atol=1e-6)
    np.testing.assert_allclose(final[3][:3, 3], [times[3], 0.01, 0], atol=1e-6)


def test_nothing_tracked_gives_no_trajectory(fake_orb_slam3):
    live, final = run(Recorded(3, lambda frame: frame.depth.fill(0)))
    assert live == final == [None] * 3


def test_figures_of_a_run(fake_orb_slam3, tmp_path):
    figures = measure(job(), tmp_path, None)["figures"]
    assert figures["frames"] == 4
    assert figures["lost_frames"] == 1
    assert figures["fps"] > 0 and figures["peak_rss_mb"] > 0
    assert 0 < figures["ate_rmse_cm"] < 10 and 0 < figures["ate_live_cm"] < 10


def test_run_in_the_pool(fake_orb_slam3, tmp_path):
    tiny = job()
    outcome = run_jobs({tiny.key(): tiny}, tmp_path / "out", LocalExecutor(threads=1))[tiny.key()]
    assert outcome.record is not None, outcome.error
    assert outcome.record["figures"]["frames"] == 4


@pytest.mark.parametrize(
    ("vocabulary", "message"),
    [
        ("refused", "ORB-SLAM3 failed: Vocabulary is not one of ORB features"),
        ("fatal", "ORB-SLAM3 ended with exit code 3: Wrong path to vocabulary."),
        ("dies", "ORB-SLAM3 ended with exit code 4"),
    ],
)
def test_failure_of_the_library_is_one_line(fake_orb_slam3, vocabulary, message):
    fake_orb_slam3.write_text(vocabulary)
    with pytest.raises(SpslamError, match=f"^{re.escape(message)}$"):
        run(Recorded(4))


def test_files_are_removed(fake_orb_slam3, monkeypatch, tmp_path):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    run(Recorded(2))
    fake_orb_slam3.write_text("refused")
    with pytest.raises(SpslamError):
        run(Recorded(2))
    assert not list((tmp_path / "temporary").iterdir())


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyorbslam3", None)
    with pytest.raises(SpslamError, match=r"needs pyorbslam3, .*GPL-3: pip install 'spslam\[orbslam3\]'"):
        OrbSlam3(Recorded(1).camera, RATE_HZ)


def test_missing_vocabulary_is_named(fake_orb_slam3, monkeypatch):
    assert orb_slam3_off_reason() == ""
    fake_orb_slam3.unlink()
    with pytest.raises(SpslamError, match=rf"{VOCABULARY} must name ORBvoc.txt, .*, got .*, which is not a"):
        OrbSlam3(Recorded(1).camera, RATE_HZ)
    monkeypatch.delenv(VOCABULARY)
    assert orb_slam3_off_reason().endswith("ORBvoc.txt.tar.gz of github.com/UZ-SLAMLab/ORB_SLAM3")


@pytest.mark.parametrize(("size", "levels"), [((640, 480), 8), ((320, 240), 8), ((256, 192), 6), ((67, 90), 1)])
def test_small_images_have_fewer_pyramid_levels(size, levels):
    settings = orb_slam3_settings(Camera(*size, 300.0, 301.0, 127.5, 95.5), 29.6)
    assert f"ORBextractor.nLevels: {levels}\n" in settings
    assert f"Camera.width: {size[0]}\nCamera.height: {size[1]}\nCamera.fps: 30\n" in settings


def test_too_small_images_are_refused():
    with pytest.raises(SpslamError, match="needs images of at least 67x67 px, got 80x60"):
        orb_slam3_settings(Camera(80, 60, 70.0, 70.0, 39.5, 29.5), RATE_HZ)


def test_every_seed_is_another_run(fake_orb_slam3):
    """It has no seed, but threads."""
    plan = make_plan(load_suite("quick", ["fast"], ["room"], seeds=3), None, "cpu")
    assert len(plan.cells["all", "room", "ORB-SLAM3"]) == 3
    assert "ORB-SLAM3" not in plan.skipped


def test_key_depends_on_the_vocabulary(fake_orb_slam3, monkeypatch, tmp_path):
    keys = {job().key()}
    (tmp_path / "other.txt").write_text("other words")
    monkeypatch.setenv(VOCABULARY, str(tmp_path / "other.txt"))
    assert len(keys | {job().key()}) == 2


@pytest.mark.slow
def test_the_library_follows_a_generated_place(monkeypatch, tmp_path):
    if REAL_VOCABULARY is not None:
        monkeypatch.setenv(VOCABULARY, REAL_VOCABULARY)
    if reason := orb_slam3_off_reason():
        pytest.skip(reason)
    options = (("dataset.place", "arcade"), ("dataset.sensor", "structured_light"))
    figures = measure(job(sequence="arcade", config="places", options=options, frames="0:60"), tmp_path, 1)["figures"]
    assert figures["frames"] == 60
    assert figures["lost_frames"] <= 60 - TRACKED
    assert figures["ate_rmse_cm"] < ATE_CM and figures["ate_live_cm"] < ATE_CM
