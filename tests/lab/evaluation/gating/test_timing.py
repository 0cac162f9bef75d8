"""Gate edges against the truth: the ideal gate, the pairing, the table, and one recording from end to end."""

import csv
from dataclasses import dataclass, replace

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.gating.windows import AmplitudeWindow, PhaseWindow
from engine.offline.offline_gate import Edge, TimedFrame
from lab.evaluation.gating import timing as gate_timing
from lab.evaluation.gating.tables import gate_table, mark_ms
from lab.evaluation.gating.timing import (
    DWELL_MS,
    EdgeTiming,
    _compare,
    _real_edges,
    _TrueMotion,
    plan,
    true_phase_percent,
)
from service.cli import app
from tests.support.gating.streams import measured, motion_of

pytestmark = pytest.mark.slow

PERIOD_S, AMPLITUDE_MM = 4.0, 5.0
BELOW_MIDDLE = AmplitudeWindow(lower=-50.0, upper=5.0)


def motion_mm(seconds):
    """Between 0 at the end of exhale, at 0 s, and 10 mm."""
    return AMPLITUDE_MM * (1.0 - np.cos(2.0 * np.pi * np.asarray(seconds) / PERIOD_S))


@dataclass
class SineTruth:
    """As much of a truth as is looked at: the whole, the thorax and everything else breathe alike."""

    timestamp_us = (np.arange(0.0, 20.0, 1.0 / 30.0) * 1e6).astype(np.int64)

    def __post_init__(self):
        depth = 900.0 - motion_mm(self.timestamp_us * 1e-6)
        self.whole_depth_mm = self.thorax_depth_mm = self.abdomen_depth_mm = depth
        self.cell_depth_mm = np.broadcast_to(depth[:, None, None], (len(depth), 35, 20))
        self.point_depth_mm = np.broadcast_to(depth[:, None], (len(depth), 5))
        self.volume_l = motion_mm(self.timestamp_us * 1e-6) / 20.0


@pytest.fixture(scope="module")
def true():
    return _TrueMotion(SineTruth(), 0)


def seen(late_s=0.0):
    """Frames that show the motion as it was ``late_s`` ago, each computed in 2 ms."""
    frames = []
    for number, at_us in enumerate(SineTruth.timestamp_us.tolist()):
        motion = motion_of(float(motion_mm(at_us * 1e-6 - late_s)))
        measurement = replace(measured(number, motion), timestamp_us=at_us)
        frames.append(TimedFrame(measurement=measurement, computing_ns=2_000_000))
    return frames


def test_the_ideal_gate_switches_where_the_truth_crosses_and_the_dwell_is_over(true):
    edges = true.edges(BELOW_MIDDLE, 2_000_000)
    on = [edge.at_us / 1e6 for edge in edges if edge.is_on]
    off = [edge.at_us / 1e6 for edge in edges if not edge.is_on]
    assert on == pytest.approx([3.0 + 4.0 * n + DWELL_MS / 1000.0 for n in range(len(on))], abs=0.002)
    assert off == pytest.approx([5.0 + 4.0 * n for n in range(len(off))], abs=0.002)
    assert len(on) >= 4


def test_the_true_phase_is_nought_at_the_end_of_inhale_and_half_at_the_end_of_exhale():
    seconds = np.arange(0.0, 20.0, 0.001)
    phase = true_phase_percent(motion_mm(seconds), seconds)
    assert phase[2000] == pytest.approx(0.0, abs=0.1)
    assert phase[4000] == pytest.approx(50.0, abs=0.1)
    assert np.isnan(phase[:1900]).all()
    assert np.isnan(phase[-1900:]).all()


def test_a_phase_window_is_judged_by_hindsight(true):
    edges = true.edges(PhaseWindow(from_percent=25.0, to_percent=75.0), 2_500_000)
    assert [edge.at_us / 1e6 for edge in edges[:2]] == pytest.approx([3.0 + DWELL_MS / 1000.0, 5.0], abs=0.01)


@pytest.mark.parametrize("late_ms", [0.0, 50.0])
def test_a_measurement_that_is_late_makes_edges_that_are_late(true, late_ms):
    real = _real_edges(BELOW_MIDDLE, seen(late_ms / 1000.0), 2_000_000, {})
    on, off = _compare("k", plan(1, 60.0)[0], real, true.edges(BELOW_MIDDLE, 2_000_000), BELOW_MIDDLE, true)
    for timing in (on, off):
        assert timing.missed == timing.extra == 0
        assert len(timing.delays_ms) >= 4
        assert (timing.delays_ms >= late_ms + 0.9).all()
        assert (timing.delays_ms <= late_ms + mark_ms(30.0)).all()
    assert off.beyond.max() == pytest.approx(7.85e-3 * off.delays_ms.max(), rel=0.2)


def test_edges_without_a_partner_are_counted(true):
    ideal = [Edge(at_us=1e6, is_on=True), Edge(at_us=2e6, is_on=False), Edge(at_us=5e6, is_on=True)]
    real = [Edge(at_us=1.01e6, is_on=True), Edge(at_us=3e6, is_on=False)]
    on, off = _compare("k", plan(1, 60.0)[0], real, ideal, BELOW_MIDDLE, true)
    assert (on.delays_ms.tolist(), on.missed, on.extra) == (pytest.approx([10.0]), 1, 0)
    assert (off.delays_ms.tolist(), off.missed, off.extra) == ([], 1, 1)


def timing(delays_ms, **changes):
    values = {"kind": "exhale", "run": "G01", "is_on": False, "missed": 0, "extra": 0, "beyond": np.array([0.1])}
    return EdgeTiming(delays_ms=np.array(delays_ms), **(values | changes))


@pytest.mark.parametrize(
    ("timings", "is_failed"),
    [
        ([timing([10.0]), timing([43.3], run="G02")], False),
        ([timing([10.0]), timing([43.4], run="G02")], True),
        ([timing([10.0], missed=1)], True),
        ([timing([10.0], extra=1)], True),
        ([timing([])], True),
    ],
)
def test_a_row_is_red_where_an_edge_is_late_missed_or_extra(timings, is_failed):
    table = gate_table(timings, 30.0)
    assert len(table.rows) == 1
    assert (table.failed == frozenset({0})) is is_failed


def test_the_command_writes_the_table_of_what_it_gated(tmp_path, regular_volunteer, monkeypatch):
    monkeypatch.setattr(gate_timing, "make_dataset", lambda *_: None)
    monkeypatch.setattr(
        gate_timing, "plan", lambda seed, seconds: [replace(one, name=".") for one in plan(seed, seconds)[:1]]
    )
    monkeypatch.setattr(gate_timing, "WARM_UP_US", 0)
    out = tmp_path / "out"
    options = ["--edges-only", "--out", str(out), "--work", str(regular_volunteer)]
    result = CliRunner().invoke(app, ["evaluate", "gate", *options])
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader((out / "gate_edges.csv").read_text().splitlines()))
    assert {row["window"] for row in rows} == {kind.name for kind in gate_timing.KINDS if kind.scenario == "regular"}
    whole = next(row for row in rows if row["window"] == "exhale, whole" and row["beam goes"] == "off")
    assert int(whole["edges"]) >= 1


@pytest.mark.parametrize("other", [["--rules-only"], ["--volunteer", "1"]])
def test_the_edges_alone_exclude_what_is_of_the_rules(tmp_path, other):
    result = CliRunner().invoke(app, ["evaluate", "gate", "--edges-only", *other, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "edges-only" in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("option", "value"), [("--seconds", "39"), ("--seed", "-1")])
def test_a_number_out_of_its_bound_is_refused(tmp_path, option, value):
    result = CliRunner().invoke(app, ["evaluate", "gate", "--out", str(tmp_path / "out"), option, value])
    assert result.exit_code == 2
    assert option.removeprefix("--") in result.output
    assert not (tmp_path / "out").exists()
