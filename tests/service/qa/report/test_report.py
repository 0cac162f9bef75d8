"""The report of a QA run, read back as paper: every check, its verdict as a word, and the same bytes each time."""

import hashlib
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from engine.qa.checks import checks_of
from engine.qa.results import QaKind
from service.qa.report.panels import axis_ticks, series_panel, trend_panel
from service.qa.report.report import report_document, report_pdf
from service.qa.report.style import DASH, LOOKS, number
from service.qa.schemas import QaCurve, QaSeries
from tests.support.qa.sample_runs import report, run_detail, sample_series, trends
from tests.support.repository import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.verification]


def read(pdf: bytes, tmp_path) -> str:
    path = tmp_path / "report.pdf"
    path.write_bytes(pdf)
    return subprocess.run(["pdftotext", "-layout", path, "-"], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("kind", list(QaKind), ids=str)
def test_the_paper_names_every_check_and_its_verdict(kind, tmp_path):
    detail = run_detail(kind, made=report(kind, series=sample_series()))
    text = read(report_pdf(detail, trends(detail)), tmp_path)
    assert f"{kind.capitalize()} QA" in text
    for check in checks_of(kind):
        line = next(line for line in text.splitlines() if line.strip().startswith(check.title) and "PASS" in line)
        assert line.split()[-1] == "PASS"
    for said in ("St. Example Hospital", "Linac 2", "A. Physicist", "2026-11-21 12:00:00", "no. 1", detail.id):
        assert said in text
    assert "not cleared for clinical use" in text


@pytest.mark.parametrize("kind", list(QaKind), ids=str)
def test_it_is_two_pages_at_most_and_everything_lies_on_them(kind, tmp_path):
    detail = run_detail(kind, made=report(kind, series=sample_series() * 3, duty_cycle_change_percent=None))
    text = read(report_pdf(detail, trends(detail)), tmp_path)
    assert text.count("not cleared for clinical use") == text.count("page ") <= 2
    panels = report_document(detail, trends(detail))
    assert len(panels["series"]) == 6
    for panel in panels["series"] + panels["trends"]:
        assert panel["title"] in text
        places = [point for line in panel["lines"] for point in line["points"]]
        places += [mark["place"] for mark in panel.get("marks", ())]
        assert places
        assert np.array(places).min() >= 0.0
        assert np.array(places).max() <= 1.0


def test_a_daily_run_fits_on_one_page(tmp_path):
    detail = run_detail(made=report(series=sample_series()[:1]))
    assert "page 1 of 1" in read(report_pdf(detail, trends(detail)), tmp_path)


def trend_of(*deviations: float | None, warn: float = 1.0, fail: float = 2.0):
    detail = run_detail()
    one = next(one for one in trends(detail, runs=len(deviations)) if one.sidedness == "absolute")
    points = [
        point.model_copy(
            update={
                "deviation": value,
                "warn": warn,
                "fail": fail,
                "verdict": "fail" if value and abs(value) > fail else "pass",
            }
        )
        for point, value in zip(one.items, deviations, strict=True)
    ]
    return trend_panel(one.model_copy(update={"items": points}))


def test_a_trend_shows_its_bounds_its_gaps_and_what_lies_beyond_the_axis():
    marks = trend_of(0.5, None, -40.0, 0.0)["marks"]
    assert [mark["shape"] for mark in marks] == ["circle", "cross", "square", "circle"]
    assert [mark["is_newest"] for mark in marks] == [False, False, False, True]
    assert [mark["label"] for mark in marks] == ["", "", "\N{MINUS SIGN}40", ""]
    assert [mark["place"][1] for mark in marks] == pytest.approx([0.5 + 0.25 / 5.8, 0.5, 0.02, 0.5], abs=1e-4)
    warn, fail = trend_of(0.5, 0.5)["lines"][:2]
    assert (warn["dash"], fail["dash"]) == ("dashed", "solid")
    assert [point[1] for point in warn["points"]] == pytest.approx([0.5 + 0.5 / 2.9] * 4, abs=1e-4)
    assert [point[1] for point in fail["points"]] == pytest.approx([0.5 + 1.0 / 2.9] * 4, abs=1e-4)


def test_a_curve_of_a_narrow_range_is_not_blown_up_and_a_missing_value_breaks_it():
    flat = QaSeries(
        code="x",
        title="t",
        x_label="time [s]",
        y_label="distance [mm]",
        curves=[QaCurve(name="a", x=[0.0, 1.0, 2.0], y=[850.0, float("nan"), 850.1])],
    )
    first, missing, last = series_panel(flat)["lines"][0]["points"]
    assert missing[1] == -1.0, "the template draws nothing there"
    assert last[1] - first[1] == pytest.approx(0.1 / 2.0, abs=1e-3), "0.1 of a span of 2 mm"


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.0, 60.0, ["0", "10", "20", "30", "40", "50", "60"]),
        (-1.45, 1.45, ["\N{MINUS SIGN}1", "0", "1"]),
        (849.2, 851.2, ["849.5", "850", "850.5", "851"]),
    ],
)
def test_axes_have_round_numbers(low, high, words):
    found = axis_ticks(low, high, 6 if high == 60.0 else 4)
    assert [word for _, word in found] == words
    assert [share for share, _ in found] == sorted(share for share, _ in found)


def test_a_failure_is_reported_by_its_word_its_place_and_why(tmp_path):
    detail = run_detail(made=report(plate_noise_mm=9.0, camera_distance_mm=None))
    text = read(report_pdf(detail, trends(detail)), tmp_path)
    lines = text.splitlines()
    assert "FAIL" in lines[0] + lines[1] + lines[2], "the run's verdict is at the top"
    assert "13 pass, 0 warn, 2 fail" in text
    assert next(line for line in lines if line.strip().startswith("Noise of a pixel")).split()[-1] == "FAIL"
    assert "Camera distance: not measured; no plate was seen" in text
    assert next(line for line in lines if line.strip().startswith("Read-back errors")).split()[-1] == "PASS"


def test_in_black_and_white_a_failure_is_solid_a_warning_and_a_pass_are_not(tmp_path):
    looks = {verdict: look.is_solid for verdict, look in LOOKS.items()}
    assert looks == {"pass": False, "warn": False, "fail": True}
    assert len({look.marker for look in LOOKS.values()}) == 3
    detail = run_detail(made=report(plate_noise_mm=9.0))
    (tmp_path / "r.pdf").write_bytes(report_pdf(detail, []))
    subprocess.run(["pdftoppm", "-gray", "-r", "50", tmp_path / "r.pdf", tmp_path / "r"], check=True)
    page = cv2.imread(str(next(tmp_path.glob("r*.pgm"))), cv2.IMREAD_GRAYSCALE)
    dark = cv2.morphologyEx((page < 110).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 6), np.uint8))
    assert cv2.connectedComponents(dark)[0] - 1 == 2, "the run's badge and the one check's"


def test_a_simulated_run_states_it_in_words(tmp_path):
    detail = run_detail(is_simulated=True)
    assert "SIMULATED FROM END TO END" in read(report_pdf(detail, trends(detail)), tmp_path)
    plain = run_detail()
    assert "END TO END" not in read(report_pdf(plain, trends(plain)), tmp_path)


def test_the_first_run_of_all_and_one_that_measured_nothing_are_printed_too():
    nothing = report(**{check.code: None for check in checks_of(QaKind.DAILY)})
    detail = run_detail(made=nothing, site="", machine="", sha256=None, calibration_sha256=None, baseline_number=None)
    assert report_pdf(detail, trends(detail, runs=1)).startswith(b"%PDF")
    assert report_pdf(detail, []).startswith(b"%PDF")


def test_names_that_look_like_formulas_are_printed_as_they_are(tmp_path):
    detail = run_detail(operator="A. $x^2$ & B", note="50 % of $y$ \\alpha", site="$S$", machine="{M}_1")
    text = read(report_pdf(detail, trends(detail)), tmp_path)
    for said in ("A. $x^2$ & B", "50 % of $y$ \\alpha", "$S$", "{M}_1"):
        assert said in text


def test_the_same_run_gives_the_same_bytes_in_every_process():
    code = (
        "import hashlib, sys; from tests.support.qa.sample_runs import *; "
        "from service.qa.report.report import report_pdf; "
        "d = run_detail(made=report(series=sample_series())); "
        "sys.stdout.write(hashlib.sha256(report_pdf(d, trends(d))).hexdigest())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | {"PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    detail = run_detail(made=report(series=sample_series()))
    assert done.stdout == hashlib.sha256(report_pdf(detail, trends(detail))).hexdigest()


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [
        (None, "mm", DASH),
        (0.0, "", "0"),
        (-0.0004, "", "0"),
        (-0.2, "mm", "\N{MINUS SIGN}0.2 mm"),
        (0.0214, "", "0.021"),
        (1.005, "", "1"),
        (849.94, "mm", "849.9 mm"),
        (100.0, "ms", "100 ms"),
        (20.0, "%", "20 %"),
        (1234.5, "", "1234"),
    ],
)
def test_a_figure_is_written_as_a_person_reads_it(value, unit, said):
    assert number(value, unit) == said
