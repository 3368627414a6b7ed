"""The shipped suites and the paper's figures for them."""

import sys

import pytest

from spslam.benchmark.figures import FIGURES
from spslam.benchmark.folders import read_folders, with_folders
from spslam.benchmark.jobs import Job, make_plan
from spslam.benchmark.published import AVERAGE, published
from spslam.benchmark.suites import GICP, ORB_SLAM3, SPSLAM, load_suite, suite_names
from spslam.config import load_config
from spslam.datasets.places.registry import PLACES
from spslam.errors import ConfigError
from tests.benchmark.examples import tiny_job
from tests.cli.command import ROOT

DATASETS = {"replica": 8, "synthetic_rgbd": 6, "scannet": 6, "tum": 3, "7scenes": 7}


@pytest.mark.parametrize("name", suite_names())
def test_every_run_of_a_suite_has_a_valid_configuration(name, tmp_path):
    suite = load_suite(name)
    assert suite.studies
    for study in suite.studies:
        assert set(study.columns) | set(study.plots) <= set(FIGURES)
        for sequence in study.sequences:
            for variant in study.variants:
                options = (*sequence.options, *(variant.options if variant.method == SPSLAM else ()))
                load_config(sequence.config, variant.preset, options)


@pytest.mark.parametrize(("name", "scenes"), DATASETS.items())
def test_datasets_have_the_papers_scenes_five_seeds_and_the_baselines(name, scenes):
    suite = load_suite(name)
    (study,) = suite.studies
    assert suite.seeds == 5
    assert [variant.preset for variant in study.variants[:2]] == ["paper", "balanced"]
    assert [variant.method for variant in study.variants[2:]] == [ORB_SLAM3, GICP]
    names = [sequence.name for sequence in study.sequences]
    assert len(names) == scenes
    columns = published(suite.published)["ate"].columns
    assert [column for column in columns if column != AVERAGE] == names


@pytest.mark.parametrize("name", ["replica", "synthetic_rgbd", "scannet", "7scenes"])
def test_published_averages_match_their_rows(name):
    """Not so for some baselines, in the paper itself."""
    *values, average = published(name)["ate"].rows["SP-SLAM (paper)"]
    assert average == pytest.approx(sum(values) / len(values), abs=0.05)


@pytest.mark.parametrize("name", [*DATASETS, "ablation"])
def test_published_rows_are_complete(name):
    for table in published(name).values():
        assert all(len(row) == len(table.columns) for row in table.rows.values())
        assert table.table.startswith("Table ")


def test_nothing_is_published_about_other_suites():
    assert published("quick") == published(None) == {}


def test_part_of_a_suite():
    suite = load_suite("quick", ["fast"], ["room", "gray"], None, "0:5", 3, baseline=False)
    (study,) = suite.studies
    assert [sequence.name for sequence in study.sequences] == ["room", "gray"]
    assert {sequence.frames for sequence in study.sequences} == {"0:5"}
    assert [variant.preset for variant in study.variants] == ["fast"]
    assert suite.seeds == 3
    assert [study.name for study in load_suite("ablation", studies=["fusion"]).studies] == ["fusion"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "replika"}, "suite must be one of .*replica.*, got replika"),
        ({"name": "quick", "sequences": ["rom"]}, "sequence must be one of room, .*, got rom"),
        ({"name": "ablation", "studies": ["x"]}, "study must be one of prior, .*, got x"),
        ({"name": "quick", "studies": ["prior"]}, "study must be one of all, got prior"),
    ],
)
def test_unknown_names_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        load_suite(**arguments)


def test_plan_has_the_data_that_is_there_and_lists_what_is_missing(tmp_path):
    (tmp_path / "replica" / "room1").mkdir(parents=True)
    (tmp_path / "replica" / "room1_mesh.ply").touch()
    plan = make_plan(load_suite("replica", seeds=2), tmp_path, "cpu")
    assert set(plan.skipped) == {f"room{i}" for i in (0, 2)} | {f"office{i}" for i in range(5)} | {"ORB-SLAM3"}
    assert f"in {tmp_path}" in plan.skipped["room0"]
    # Two presets with two seeds, and GICP, which has none.
    assert len(plan.jobs) == 5
    assert {job.mesh for job in plan.jobs.values()} == {str(tmp_path / "replica" / "room1_mesh.ply")}
    assert plan.cells["all", "room1", "spslam paper"] == tuple(
        key for key, job in plan.jobs.items() if job.preset == "paper"
    )


def test_folders_from_a_file(tmp_path):
    (tmp_path / "mine" / "kitchen").mkdir(parents=True)
    file = tmp_path / "folders.yaml"
    file.write_text(f"quick: {{kitchen: mine/kitchen, rpy: {tmp_path / 'absent'}}}\n7scenes: {{fire: elsewhere}}\n")
    suite = with_folders(load_suite("quick", ["fast"], ["kitchen", "rpy", "gray"], baseline=False), read_folders(file))
    plan = make_plan(suite, tmp_path, "cpu")
    assert [job.data for job in plan.jobs.values()] == [str(tmp_path / "mine" / "kitchen")]
    assert plan.skipped["rpy"].startswith(f"none of {tmp_path / 'absent'} in {tmp_path}; --folders FILE names other")
    assert plan.skipped["gray"].startswith("none of neural_rgbd_data/grey_white_room, ")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "can't be read: No such file"),
        ("a: [", "must be YAML"),
        ("- quick", "must contain SUITE: {SEQUENCE: FOLDER}, got"),
        ("quik: {kitchen: x}", "suite must be one of .*quick.*, got quik"),
        ("quick: kitchen", "quick must contain SEQUENCE: FOLDER, got kitchen"),
        ("quick: {kitschen: x}", "a sequence of quick must be one of kitchen, .*, got kitschen"),
        ("quick: {room: x}", "a sequence of quick must be one of kitchen, .*, got room"),
        ("quick: {kitchen: 3}", "the folder of quick, kitchen must be text, got 3"),
    ],
)
def test_wrong_file_of_folders_is_one_line(tmp_path, content, message):
    file = tmp_path / "folders.yaml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError, match=f"folders.yaml: {message}") as error:
        read_folders(file)
    assert "\n" not in str(error.value)


def test_repository_file_of_folders_is_valid():
    assert set(read_folders(ROOT / "experiments" / "bench_folders.yaml")) <= set(suite_names())


def test_suites_name_public_folders_only():
    """A suite lists parent folders of the dataset's own folder name; other names belong in a `--folders` file."""
    for name in suite_names():
        for sequence in load_suite(name).studies[0].sequences:
            assert len({folder.rpartition("/")[2] for folder in sequence.folders}) <= 1, sequence.name


def test_without_data_only_generated_sequences_are_planned():
    plan = make_plan(load_suite("quick"), None, "cpu")
    assert {job.sequence for job in plan.jobs.values()} == {"room"}
    assert plan.skipped.pop("ORB-SLAM3").startswith("needs ")
    assert set(plan.skipped.values()) == {"no --data given"}


def test_generated_places_need_no_data_and_differ():
    plan = make_plan(load_suite("places", ["balanced"], seeds=1), None, "cpu")
    assert set(plan.skipped) == {"ORB-SLAM3"}
    assert len(plan.jobs) == 12
    places = {job.sequence: job.load_config().dataset for job in plan.jobs.values()}
    assert set(places) == set(PLACES)
    assert all(options.place == name for name, options in places.items())
    assert {(options.sensor, options.motion) for options in places.values()} == {("structured_light", "handheld")}


def test_without_its_package_a_baseline_is_skipped(monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    monkeypatch.setitem(sys.modules, "pyorbslam3", None)
    plan = make_plan(load_suite("quick", presets=["fast"], sequences=["room"]), None, "cpu")
    assert [job.method for job in plan.jobs.values()] == ["spslam"]
    assert plan.skipped == {
        "GICP odometry, 4 cm": "needs small_gicp: pip install 'spslam[bench]'",
        "ORB-SLAM3": "needs pyorbslam3, which is licensed under GPL-3: pip install 'spslam[orbslam3]'",
    }


def test_studies_share_runs():
    plan = make_plan(load_suite("ablation", studies=["fusion", "targets"], sequences=["room"]), None, "cpu")
    assert plan.cells["fusion", "room", "with fusion"] == plan.cells["targets", "room", "cosine targets"]
    assert len(plan.jobs) == 5


def test_key_depends_on_all_that_affects_the_figures():
    job = tiny_job()
    others = [
        tiny_job(seed=1),
        tiny_job(method=GICP),
        tiny_job(frames="0:5"),
        tiny_job(preset="paper"),
        tiny_job(mesh="truth.ply"),
        tiny_job(thorough=True),
        tiny_job(options=()),
        tiny_job(options=(*job.options, ("mesh.resolution_m", 0.05))),
        tiny_job(options=(*job.options, ("run.reader", "threads"))),
        tiny_job(options=(*job.options, ("scene.max_voxels", 100000))),
    ]
    assert len({job.key(), *(other.key() for other in others)}) == 11
    assert len({tiny_job(config="tum", options=(), data=data).key() for data in ("/here", "/elsewhere")}) == 1
    assert job.key().startswith("room-fast-seed0-")


def test_key_depends_on_the_weights(tmp_path):
    from spslam.prior.encoder import SHIPPED

    content = bytearray(SHIPPED.read_bytes())
    content[-1] ^= 1
    keys = set()
    for name, weights in (("same", SHIPPED.read_bytes()), ("other", bytes(content))):
        (tmp_path / "w.safetensors").write_bytes(weights)
        keys.add(tiny_job(options=(("prior.weights", str(tmp_path / "w.safetensors")),)).key())
        assert name
    assert len(keys) == 2


def test_job_from_its_text():
    for job in (tiny_job(), tiny_job(method=GICP)):
        assert Job.from_json(job.to_json()) == job
