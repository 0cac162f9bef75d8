"""``tidegate export 4dct`` of what `tidegate measure` wrote and of traces of other instruments."""

import numpy as np
import pytest
from typer.testing import CliRunner

from service.cli import app
from tests.support.exchange.breaths import PERIOD_S, breath
from tests.support.repository import ROOT

REAL = next((ROOT / "tests/data/rpm").glob("*.vxp"))


def called(*words):
    return CliRunner().invoke(app, ["export", "4dct", *map(str, words)])


@pytest.fixture
def motion(tmp_path):
    at, abdomen = breath()
    path = tmp_path / "P-1" / "motion.csv"
    path.parent.mkdir()
    rows = [
        f"{i},{round(1e6 * t) + 77},{mm:.4f},{'' if i < 5 else mm / 2},hold"
        for i, (t, mm) in enumerate(zip(at, abdomen, strict=True))
    ]
    path.write_text("\n".join(["frame_index,timestamp_us,abdomen_mm,whole_mm,gate", *rows, ""]))
    return path


def test_each_image_has_its_place_and_its_mark(motion, tmp_path):
    times = tmp_path / "images.txt"
    images = np.arange(12.0, 20.0, 0.5)
    times.write_text("".join(f"{at:.3f}\n" for at in images))
    done = called(motion, "--out", tmp_path / "ct", "--signal", "abdomen", "--bins", 8, "--times", times)
    assert done.exit_code == 0, done.output
    assert "16 images, 8 bins" in done.output
    phases = np.array([float(line) for line in (tmp_path / "ct/phases.txt").read_text().split()])
    assert np.abs((phases - images / PERIOD_S + 0.5) % 1.0 - 0.5).max() < 0.02
    assert len((tmp_path / "ct/bins.csv").read_text().splitlines()) == 9
    curve = (tmp_path / "ct/curve.vxp").read_text()
    assert "Patient_ID=P-1" in curve
    assert sum(row.split(",")[4] == "1" for row in curve.split("[Data]")[1].split()) == 16


def test_without_images_every_value_with_a_place_is_listed(tmp_path):
    done = called(REAL, "--out", tmp_path / "ct", "--sorting", "local_amplitude")
    assert done.exit_code == 0, done.output
    assert len((tmp_path / "ct/phases.txt").read_text().split()) > 3000


def test_an_image_outside_of_the_breaths_is_refused_by_its_number(motion, tmp_path):
    times = tmp_path / "images.txt"
    times.write_text("12.0\n39.9\n")
    done = called(motion, "--out", tmp_path / "ct", "--signal", "abdomen", "--times", times)
    assert (done.exit_code, (tmp_path / "ct").exists()) == (2, False)
    assert "image 2" in done.output


def test_a_curve_without_two_breaths_has_no_places(motion, tmp_path):
    lines = motion.read_text().splitlines()
    motion.write_text("\n".join([*lines[:40], ""]))
    done = called(motion, "--out", tmp_path / "ct", "--signal", "abdomen")
    assert (done.exit_code, (tmp_path / "ct").exists()) == (2, False)
    assert "at least two breaths" in done.output


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("motion.csv", "timestamp_us,whole_mm\n1,2\n", "at least 2"),
        ("motion.csv", "timestamp_us,whole_mm\n2,2\n1,3\n", "must increase"),
        ("motion.csv", "timestamp_us,whole_mm\nx,2\n", "line 2"),
        ("motion.csv", "a,b\n1,2\n", "motion.csv"),
        ("images.txt", "", "1 to 100000"),
        ("images.txt", "nan\n", "finite"),
        ("images.txt", "1,0\n", "one time"),
    ],
)
def test_files_that_are_none_are_refused_by_name(motion, tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    words = [motion, "--signal", "abdomen", "--times", path] if name == "images.txt" else [path]
    done = called(*words, "--out", tmp_path / "ct")
    assert (done.exit_code, (tmp_path / "ct").exists()) == (2, False)
    assert said in done.output
