"""`tidegate evaluate spirometer` on a virtual volunteer."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.phantom.truth import load_truth
from service.cli import app


def invoke(folder, flow, out, *extra):
    arguments = ["evaluate", "spirometer", str(folder / "recording.oni"), str(flow)]
    arguments += ["--calibration", str(folder / "calibration.json"), "--out", str(out)]
    return CliRunner().invoke(app, [*arguments, *extra])


def figure(outcome, name):
    line = next(line for line in outcome.stdout.splitlines() if name in line)
    return float(line.split("│")[-1].split()[0])


def test_the_command_finds_the_lag_and_writes_both_volumes(lit_volunteer, tmp_path):
    truth = load_truth(lit_volunteer / "truth.npz")
    outcome = invoke(lit_volunteer, lit_volunteer / "flow.csv", tmp_path / "x")
    assert outcome.exit_code == 0, outcome.output
    assert figure(outcome, "lag") == pytest.approx(float(truth.spirometer_lag_s), abs=0.05)
    assert figure(outcome, "correlation") > 0.99
    assert figure(outcome, "scale") == pytest.approx(1.0, abs=0.15)
    assert sorted(path.name for path in (tmp_path / "x").iterdir()) == ["spirometer.csv", "spirometer.png"]
    with (tmp_path / "x" / "spirometer.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["timestamp_us"]) for row in rows] == truth.timestamp_us.tolist()
    assert (rows[0]["tidegate_l"], rows[0]["spirometer_scaled"]) == ("", "")
    for name in ("tidegate_scaled", "spirometer_scaled"):
        values = np.array([float(row[name]) for row in rows if row[name]])
        assert (values.min(), values.max()) == pytest.approx((-1.0, 1.0))
    assert (tmp_path / "x" / "spirometer.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("text", "extra", "words"),
    [
        ("time_s,flow\n", [], "line 1 is 'time_s, flow': must be two columns"),
        (None, ["--max-lag-s", "0"], "max-lag-s is 0.0: must be more than 0"),
        (None, ["--max-lag-s", "0.2"], "max-lag-s is 0.2: must be larger"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(lit_volunteer, tmp_path, text, extra, words):
    flow = lit_volunteer / "flow.csv"
    if text is not None:
        flow = tmp_path / "flow.csv"
        flow.write_text(text)
    outcome = invoke(lit_volunteer, flow, tmp_path / "x", *extra)
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert len(outcome.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()
