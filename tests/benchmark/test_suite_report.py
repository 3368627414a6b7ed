"""Statistics, tables, plots and pages from synthetic results."""

import json
import xml.etree.ElementTree as ElementTree

import pytest

from spslam.benchmark.figures import Statistic
from spslam.benchmark.suite_report import describe_gaps, fill_regions, update_page, write_results
from spslam.benchmark.suites import load_suite
from spslam.benchmark.tables import make_tables, to_markdown, to_text
from spslam.errors import OutputError
from tests.benchmark.examples import ablation, made_up_summary


def figures(sequence, variant, seed):
    return {"ate_rmse_cm": 1.0 + seed, "f1_1cm": 90.0, "frames": 20, "fps": 10.0}


@pytest.fixture
def replica():
    suite = load_suite("replica", sequences=["room0", "office4"], seeds=2)
    return made_up_summary(suite, figures, seeds=2)


def test_statistics():
    several = Statistic.of([1.0, 2.0, 3.0])
    assert (several.mean, several.deviation, several.low, several.high, several.runs) == (2.0, 1.0, 1.0, 3.0, 3)
    assert several.text(2) == "2.00 ± 1.00"
    assert Statistic.of([2.0]).text(1) == Statistic.of([2.0, 2.0]).text(1) == "2.0"


def test_tables_include_the_papers_figures(replica):
    ate, averages, runs = make_tables(replica)
    rows = {row[0]: row[1:] for row in ate.rows}
    assert ate.header == ("method", "room0", "office4", "average")
    assert rows["SP-SLAM (paper)"] == ("0.5", "0.49", "0.52")
    assert rows["spslam balanced"] == ("1.50 ± 0.71", "1.50 ± 0.71", "1.50")
    assert any(name.startswith("GICP") for name in rows)
    assert "ORB-SLAM3" in rows
    assert "Table II" in ate.note
    means = {row[0]: dict(zip(averages.header, row, strict=True)) for row in averages.rows}
    assert means["ESLAM"]["F1 % at 5 cm"] == "98.98"
    assert means["spslam paper"]["frames/s"] == "10.0"
    assert means["DROID-SLAM"]["tracking ms/it"] == ""
    assert len(runs.rows) == 8


def test_a_mean_of_fewer_sequences_or_seeds_says_so():
    def lost_in_office4(sequence, variant, seed):
        known = figures(sequence, variant, seed)
        is_lost = (variant == "ORB-SLAM3" and sequence == "office4") or (variant == "spslam paper" and seed == 1)
        return known if not is_lost else {name: value for name, value in known.items() if name != "ate_rmse_cm"}

    suite = load_suite("replica", sequences=["room0", "office4"], seeds=2)
    rows = {row[0]: row[1:] for row in make_tables(made_up_summary(suite, lost_in_office4, seeds=2))[0].rows}
    assert rows["ORB-SLAM3"][0] and rows["ORB-SLAM3"][1] == "" and rows["ORB-SLAM3"][2].endswith(" (1 of 2)")
    assert rows["spslam paper"] == ("1.00 (1 of 2)", "1.00 (1 of 2)", "1.00")
    assert rows["spslam balanced"][2] == "1.50"


def test_ablation_tables_have_a_column_for_each_sequence_and_figure():
    summary = made_up_summary(ablation(), lambda *_: {"ate_rmse_cm": 0.5})
    (table,) = make_tables(summary)
    assert table.header == ("variant", "room: ATE RMSE cm", "hall: ATE RMSE cm")
    assert table.rows[0] == ("with 1", "0.50", "0.50")
    assert "A note." in table.note


def test_failed_runs_leave_gaps():
    summary = made_up_summary(ablation(), lambda sequence, *_: None if sequence == "hall" else {"ate_rmse_cm": 0.5})
    (table,) = make_tables(summary)
    assert table.header == ("variant", "room: ATE RMSE cm")
    gaps = describe_gaps(summary)
    assert gaps[0] == "skipped absent: no --data given"
    assert len(gaps) == 5
    assert gaps[1] == "failed prior/hall/with 1/0: it broke"


def test_text_and_markdown(replica):
    table = make_tables(replica)[0]
    lines = to_text(table).splitlines()
    assert lines[0] == "ATE RMSE in cm"
    assert len(lines) == 3 + len(table.rows)
    markdown = to_markdown(table)
    assert "| ESLAM | 0.71 | 0.63 | 0.63 |" in markdown


def test_files(replica, tmp_path):
    write_results(replica, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert len(summary["rows"]) == 8
    assert summary["rows"][0]["figures"]["ate_rmse_cm"]["runs"] == 2
    assert summary["skipped"] == {"absent": "no --data given"}
    assert summary["environments"][0]["commit"] == "abc"
    page = (tmp_path / "results.md").read_text()
    assert "A processor, 2 kernel threads; spslam 1.0, commit abc, torch 2.13" in page
    assert "skipped absent: no --data given" in page
    assert "<td>SP-SLAM (paper)</td>" in (tmp_path / "results.html").read_text()


def test_plots_are_svg_and_part_of_the_page(tmp_path):
    def rising(sequence, variant, seed):
        return {"ate_rmse_cm": 100.0 if variant == "without 1" and sequence == "hall" else 1.0 + seed}

    summary = made_up_summary(ablation(), rising, seeds=2)
    write_results(summary, tmp_path)
    picture = tmp_path / "plots" / "ablation-prior-ate_rmse_cm.svg"
    root = ElementTree.fromstring(picture.read_text())
    text = "".join(root.itertext())
    for word in ("room: ATE RMSE cm", "hall: ATE RMSE cm", "iterations", "with", "without", "100"):
        assert word in text
    assert "nan" not in picture.read_text()
    assert "<svg" in (tmp_path / "results.html").read_text()
    assert "&amp;" in (tmp_path / "results.html").read_text()
    again = picture.read_bytes()
    write_results(summary, tmp_path)
    assert picture.read_bytes() == again


PAGE = """# Page
<!-- bench ablation machine -->
old
<!-- /bench -->
Words.
<!-- bench ablation prior -->
<!-- /bench -->
<!-- bench ablation plots prior -->
<!-- /bench -->
<!-- bench other prior -->
stays
<!-- /bench -->
"""


def test_regions_of_a_page_are_replaced_and_the_rest_is_kept(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    summary = made_up_summary(ablation(), figures)
    assert update_page(page, summary) == ["machine", "prior", "plots prior"]
    text = page.read_text()
    assert "old" not in text
    assert "stays" in text and "Words." in text
    assert "![With & without: ATE RMSE cm](images/ablation-prior-ate_rmse_cm.svg)" in text
    assert (tmp_path / "images" / "ablation-prior-ate_rmse_cm.svg").is_file()
    update_page(page, summary)
    assert page.read_text() == text


def test_page_without_regions_is_refused(tmp_path):
    page = tmp_path / "page.md"
    with pytest.raises(OutputError, match="page.md: no such page"):
        update_page(page, made_up_summary(ablation(), figures))
    page.write_text("nothing\n")
    with pytest.raises(OutputError, match="must have regions <!-- bench ablation NAME -->"):
        fill_regions(page, "ablation", {"x": "y"})
