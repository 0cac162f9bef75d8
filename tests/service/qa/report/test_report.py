"""The report of a QA run, read back as paper: every check, its verdict as a word, and the same bytes each time."""

import hashlib
import os
import subprocess
import sys

import pytest
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.text import Text

from engine.qa.checks import checks_of
from engine.qa.results import QaKind
from service.qa.report.report import report_pages, report_pdf
from service.qa.report.style import DASH, LOOKS, number
from tests.support.qa.sample_runs import report, run_detail, sample_series, trends
from tests.support.repository import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.verification]


def read(pdf: bytes, tmp_path) -> str:
    path = tmp_path / "report.pdf"
    path.write_bytes(pdf)
    return subprocess.run(["pdftotext", "-layout", path, "-"], check=True, capture_output=True, text=True).stdout


def words(figures: list[Figure]) -> list[str]:
    return [text.get_text() for figure in figures for text in figure.findobj(Text) if text.get_text()]


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
def test_it_is_two_pages_at_most_and_everything_lies_on_them(kind):
    detail = run_detail(kind, made=report(kind, series=sample_series() * 3, duty_cycle_change_percent=None))
    pages = report_pages(detail, trends(detail))
    assert len(pages) <= 2
    assert words(pages[-1:])
    for page in pages:
        for panel in page.axes:
            box = panel.get_position()
            assert box.x0 >= 0.0, panel
            assert box.y0 >= 0.04, "nothing lies on the foot"
            assert box.x1 <= 1.0
            assert box.y1 <= 1.0
            assert box.height > 0.02


def test_a_daily_run_fits_on_one_page():
    detail = run_detail(made=report(series=sample_series()[:1]))
    assert len(report_pages(detail, trends(detail))) == 1


def test_a_failure_is_reported_by_its_word_its_place_and_why(tmp_path):
    detail = run_detail(made=report(plate_noise_mm=9.0, camera_distance_mm=None))
    text = read(report_pdf(detail, trends(detail)), tmp_path)
    lines = text.splitlines()
    assert "FAIL" in lines[0] + lines[1] + lines[2], "the run's verdict is at the top"
    assert "13 pass, 0 warn, 2 fail" in text
    assert next(line for line in lines if line.strip().startswith("Noise of a pixel")).split()[-1] == "FAIL"
    assert "Camera distance: not measured; no plate was seen" in text
    assert next(line for line in lines if line.strip().startswith("Read-back errors")).split()[-1] == "PASS"


def test_in_black_and_white_a_failure_is_solid_a_warning_and_a_pass_are_not():
    looks = {verdict: look.is_solid for verdict, look in LOOKS.items()}
    assert looks == {"pass": False, "warn": False, "fail": True}
    assert len({look.marker for look in LOOKS.values()}) == 3
    detail = run_detail(made=report(plate_noise_mm=9.0))
    page = report_pages(detail, trends(detail))[0]
    badges = list(page.findobj(FancyBboxPatch))
    dark = [patch for patch in badges if sum(patch.get_facecolor()[:3]) < 1.2]
    assert len(badges) == 1 + len(detail.results)
    assert len(dark) == 2, "the run's and the one check's"


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
