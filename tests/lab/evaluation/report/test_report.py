"""What the bench writes: files that belong together, a page that needs nothing else, and words on the terminal."""

import base64
import csv
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.commands.evaluate.command import evaluate
from lab.evaluation.report.more_figures import draw
from lab.evaluation.report.report import write_report
from lab.evaluation.runs import datasets
from lab.evaluation.runs.scores import score_run
from lab.evaluation.table import Table
from tests.support.evaluation.outcomes import N, breath, measured_track, outcome
from tests.support.evaluation.small_bench import files_under, small_run, tiny_run

pytestmark = pytest.mark.slow

COMMAND = "tidegate evaluate --out OUT"
HOLD = {"name": "hold", "start_us": 3_000_000, "end_us": 5_000_000, "detail": {}}
SHUFFLE = {"name": "isovolume", "start_us": 3_000_000, "end_us": 5_000_000, "detail": {}}
PNG = b"\x89PNG\r\n\x1a\n"


def run_of(run, off_mm, events=(), *, lost=()):
    """A judged run made by hand, with everything a table or figure may ask for."""
    tracks = [measured_track(breath(), first, off_mm * share) for first, share in ((10, 1.0), (12, 2.0), (12, 0.5))]
    tracks[0].beta[:] = tracks[1].beta[:] = np.outer(breath(), (100.0, 10.0, 1.0))
    found = outcome(*tracks, events=events)
    for name in ("plain1", "ours1") if run.is_long else ():
        found.tracks[name] = measured_track(breath(), 10, 3.0 * off_mm)
    found.spectra |= dict.fromkeys(("plain", "ours"), np.geomspace(0.9, 1e-3, 10))
    found.notes |= {"lost": dict(lost), "spirometer_lag_s": 0.4}
    found.notes["segments"] = [{"first_frame": 0, "cause": "start"}, {"first_frame": 40, "cause": "camera_moved"}]
    found.notes["spirometer_ours"] = {"lag_s": 0.41, "correlation": 0.999}
    if run.is_pictured:
        found.tracks["bilateral"] = measured_track(breath(), 12, 4.0 * off_mm)
        surface = 850.0 + np.add.outer(np.arange(350.0) / 10.0, np.arange(200.0) / 10.0)
        names = ("frame", "unfiltered_component", "unfiltered", "plain_component", "plain", "ours_component", "ours")
        found.pictures |= dict.fromkeys((*names, "truth"), surface)
    if run.is_lowered:
        found.tracks["offline"] = measured_track(breath(), 0, off_mm)
    laser = np.tile(breath()[:, None], (1, 37))
    found.instruments |= {"laser_mm": laser, "laser_ours_mm": laser + 0.1}
    found.instruments |= {"laser_line_mm": laser[:, :5], "laser_plain_mm": laser[:, :5] + 0.2}
    return score_run(run, found)


@pytest.fixture(scope="module")
def everything():
    """Every kind of run there is, by hand."""
    regular = small_run("D01", is_long=True, is_pictured=True)
    return [
        run_of(regular, 0.1),
        run_of(small_run("D02", volunteer=2), 0.2),
        run_of(small_run("I01", group="irregular", scenario="irregular", is_long=True), 0.1),
        run_of(small_run("V01", group="isovolume", scenario="isovolume"), 0.1, [SHUFFLE]),
        run_of(small_run("H01", group="dibh", scenario="dibh"), 0.2, [HOLD]),
        run_of(small_run("S01", group="shift", scenario="shift"), 0.1),
        run_of(small_run("S03", group="couch", scenario="shift", is_lowered=True), 0.1),
        *(run_of(small_run(f"{g}-1", group=g, setting=1.0), 1.2, lost=[("coverage_low", 7)]) for g in SWEEPS),
    ]


SWEEPS = ("distance", "amplitude", "rate", "holes")


@pytest.fixture(scope="module")
def report(everything, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    tables, marks = write_report(everything, out, command=COMMAND, version="1.2.3", seed=7, settings={"quick": False})
    return out, tables, marks


class Reader(HTMLParser):
    """Collects what a page refers to, and whether its tags close."""

    def __init__(self):
        super().__init__()
        self.references, self.open, self.alts = [], [], []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.references += [value for name, value in attrs if name in {"src", "href", "srcset", "action"}]
        if tag == "img":
            self.alts.append(attributes.get("alt", ""))
        if tag not in {"img", "meta", "link", "br"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_needs_no_network_and_no_other_file(report):
    out, _, _ = report
    page = (out / "index.html").read_text()
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert all(value.startswith(("data:image/png;base64,", "#")) for value in reader.references)
    assert not re.search(r"https?://|@import|<script|<link|url\(", page)
    assert all(f"id={value[1:]}" in page for value in reader.references if value.startswith("#"))


def test_every_figure_is_on_the_page_and_in_a_file_and_states_what_it_shows(report):
    out, _, _ = report
    page = (out / "index.html").read_text()
    pictures = sorted(out.glob("*.png"))
    for number in ("05", "06", "07", "08", "11", "12", "13", "14", "15", "16", "17"):
        assert any(picture.name.startswith(f"fig{number}_") for picture in pictures)
    assert out / "more_segments.png" in pictures
    for picture in pictures:
        content = picture.read_bytes()
        assert content.startswith(PNG)
        assert base64.b64encode(content).decode() in page
    reader = Reader()
    reader.feed(page)
    assert len(reader.alts) == len(pictures)
    assert all(len(alt) > 20 for alt in reader.alts)


def test_every_table_states_which_command_printed_it_and_is_a_csv(report):
    out, tables, _ = report
    page = (out / "index.html").read_text()
    assert page.count(f"Printed by <code>{COMMAND}</code>") == len(tables) + 1
    for table in tables:
        rows = list(csv.reader((out / f"{table.name}.csv").read_text().splitlines()))
        assert rows[0] == list(table.columns)
        assert len(rows) == len(table.rows) + 1
        assert table.title.replace("'", "&#x27;") in page
    names = {table.name for table in tables}
    assert names >= {"marks", "glance", "table1", "table2", "table2_compared", "table3", "whole_roi", "laser"}
    assert names >= {"spirometer", "components", "filters", "spectra", *(f"sweep_{group}" for group in SWEEPS)}


def test_results_hold_everything_with_version_seeds_and_settings(report, everything):
    out, tables, marks = report
    results = json.loads((out / "results.json").read_text(), parse_constant=pytest.fail)
    assert (results["version"], results["seed"], results["command"]) == ("1.2.3", 7, COMMAND)
    assert set(results["runs"]) == {one.run.name for one in everything}
    assert results["runs"]["D01"]["seed"] == 5
    assert results["runs"]["D01"]["scores"]["ours"]["cells_mm"] == pytest.approx(0.1, abs=0.01)
    assert {mark["name"] for mark in results["marks"]} == {mark.name for mark in marks}
    assert set(results["tables"]) == {table.name for table in tables}
    assert results["files"] == sorted(path.name for path in out.iterdir() if path.name != "results.json")


def test_a_silently_wrong_frame_of_a_sweep_is_shown_in_red(report):
    _, tables, _ = report
    table = next(table for table in tables if table.name == "sweep_distance")
    assert table.rows[0][-1] == N - 11
    assert table.failed == {0}
    assert "class=failed" in table.to_html()
    assert "coverage_low 7" in table.to_csv()


def test_a_smaller_report_removes_the_larger_one_s_files_and_no_others(report, everything, tmp_path):
    out = shutil.copytree(report[0], tmp_path / "out")
    (out / "mine.csv").write_text("mine")
    write_report(everything[1:2], out, command=COMMAND, version="1", seed=1, settings={})
    left = files_under(out)
    assert "mine.csv" in left
    assert not [name for name in left if name.startswith(("sweep", "fig15", "fig08")) or name.endswith(".partial")]


def test_a_run_that_was_never_measured_makes_a_page_all_the_same(tmp_path, everything):
    empty = outcome(measured_track(breath(), 10))
    empty.tracks.clear()
    empty.tracks["ours"] = type(empty.truth).empty(N)
    scored = score_run(small_run("D01", is_long=True, is_pictured=True), empty)
    _, marks = write_report([scored], tmp_path, command=COMMAND, version="1", seed=1, settings={})
    assert not any(mark.is_met for mark in marks)
    assert "MISSED" in (tmp_path / "index.html").read_text()


def test_the_same_figure_has_the_same_bytes():
    def paint(figure):
        figure.subplots().plot([0, 1], [0, 1])

    first, second = (draw("f", "F", "n", (2, 2), paint).png for _ in range(2))
    assert first == second
    assert first.startswith(PNG)


def test_a_column_with_numbers_stands_at_the_right():
    table = Table(name="t", title="T", columns=("a", "b", "c"), rows=(("x", 1.0, "w"), ("y", None, "z")))
    assert table.to_html().count("class=n") == 3


runner = CliRunner()


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--quick"], "out"),
        (["--out", "OUT", "--seconds", "5"], "seconds"),
        (["--out", "OUT", "--jobs", "0"], "jobs"),
        (["--out", "OUT", "--seed", "-1"], "seed"),
        (["--out", "FILE"], "out"),
        (["--out", "OUT", "--work", "FILE"], "work"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, arguments, field):
    (tmp_path / "FILE").write_text("a file")
    places = {"OUT": str(tmp_path / "out"), "FILE": str(tmp_path / "FILE")}
    result = runner.invoke(evaluate, [places.get(argument, argument) for argument in arguments])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"tidegate evaluate: {field} is ")
    assert result.stderr.count("\n") == 1


def test_missed_marks_are_stated_and_only_strict_fails(tmp_path, monkeypatch):
    run = tiny_run()  # teaches no one anything: every mark is missed
    monkeypatch.setattr(datasets, "quick_plan", lambda _seed, _seconds: [run])
    arguments = ["--quick", "--jobs", "1", "--out", str(tmp_path / "out")]
    lenient = runner.invoke(evaluate, arguments)
    assert lenient.exit_code == 0, lenient.output
    assert "required values not met: Whole ROI, cells of 10 px, regular breathing" in lenient.stderr
    assert "Accuracy targets" in lenient.stdout
    assert (tmp_path / "out" / "index.html").exists()
    assert (tmp_path / "out" / "work" / run.name / "measured.npz").exists()
    assert runner.invoke(evaluate, [*arguments, "--strict"]).exit_code == 1
