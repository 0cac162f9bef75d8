"""What is compared must exist: a fraction without live frames, beam or record is never good."""

import csv
import io
from types import SimpleNamespace

import pytest

from lab.simulated_tps.delivery import BeamClock, Seen
from lab.simulated_tps.fraction import checked
from lab.simulated_tps.report import BeamReport, FractionReport, fraction_table, write_report

FRAME_US = 33_333
FRAMES = 900
ON = range(300, 600)
PLANNED_S = 10.0


class Service:
    """A session that is over: its recorded frames, and on which of them the beam was on."""

    def __init__(self, recorded=range(FRAMES), on=ON, *, status="stopped"):
        self.rows = [(frame, frame in on) for frame in recorded]
        self.status = status

    def read_session(self, _session_id):
        return {"status": self.status, "summary": {"missed_frames": 0}}

    def export_samples(self, _session_id, path):
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frame_index", "timestamp_us", "gate"])
            writer.writerows([frame, frame * FRAME_US, "beam_on" if on else "hold"] for frame, on in self.rows)
        return SimpleNamespace(path=path)

    def transitions(self, _session_id):
        pairs = zip([(0, False), *self.rows], self.rows, strict=False)
        return [{"to_state": "beam_on"} for (_, before), (_, now) in pairs if now and not before]

    def audit(self, *, session_id):
        assert session_id == "s"
        return [{"action": "session.start", "outcome": "done"}]

    def verify_audit(self):
        return {"is_intact": True}


def seen(frames, on=ON):
    clock = BeamClock()
    for frame in frames:
        clock.note(Seen(frame_index=frame, timestamp_us=frame * FRAME_US, is_on=frame in on))
    return clock


def report_of(service, clock, folder, *, outcome="delivered", delivered_s=PLANNED_S):
    stretch = checked("s", clock, 0, service, folder)
    beam = BeamReport(number=1, name="AP", planned_s=PLANNED_S, delivered_s=delivered_s)
    return FractionReport(number=1, outcome=outcome, seconds=30.0, beams=(beam,), stretches=(stretch,))


def text_of(fraction):
    from rich.console import Console

    console = Console(width=200, record=True, file=io.StringIO())
    console.print(fraction_table(fraction))
    return console.export_text()


def test_all_of_it_seen_delivered_and_recorded_is_good(tmp_path):
    fraction = report_of(Service(), seen(range(FRAMES)), tmp_path)
    assert fraction.is_good, fraction.all_troubles
    assert "all checks passed" in text_of(fraction)


def test_some_frames_missed_live_and_a_late_stop_are_good(tmp_path):
    frames = [frame for frame in range(FRAMES - 40) if frame % 10]
    fraction = report_of(Service(), seen(frames), tmp_path)
    assert fraction.is_good, fraction.all_troubles


@pytest.mark.parametrize("outcome", ["delivered", "ended: no beam for 120 s"])
@pytest.mark.parametrize("on", [ON, ()], ids=["with beam", "without beam"])
def test_without_a_live_frame_nothing_fits(tmp_path, on, outcome):
    fraction = report_of(Service(on=on), BeamClock(), tmp_path, outcome=outcome, delivered_s=0.0)
    assert not fraction.is_good
    assert "no live frame was received" in fraction.all_troubles
    assert "no live frame was received" in text_of(fraction)
    assert "all checks passed" not in text_of(fraction)


SHORT = "the live stream"
VACUOUS = {
    "no beam delivered": (Service(), range(FRAMES), ON, 0.0, "beam 1: 0.00 s of 10.00 s were delivered"),
    "no beam seen live": (Service(on=()), range(FRAMES), (), PLANNED_S, "no beam was seen live"),
    "no permitted sample": (Service(on=()), range(FRAMES), (), PLANNED_S, "no beam was recorded"),
    "nothing recorded": (Service(recorded=()), range(FRAMES), ON, PLANNED_S, "no sample was recorded"),
    "nothing compared": (
        *(Service(recorded=range(20), on=(), status="interrupted"), range(20, 45), (), PLANNED_S),
        "no recorded sample was compared: none of the 20 was seen live",
    ),
    "ended early": (Service(), range(700), ON, PLANNED_S, f"{SHORT} ended 6.7 s before the record"),
    "ended with the beam on": (
        *(Service(), [frame for frame in range(550) if not 310 < frame < 380], ON, PLANNED_S),
        f"{SHORT} ended 1.7 s before the last beam",
    ),
    "part of the session": (
        *(Service(), [*range(280), *range(300, 600), 899], ON, PLANNED_S),
        f"{SHORT} showed 581 of 900 recorded frames (65 %), and at least 75 % are needed",
    ),
    "part of the delivery": (
        *(Service(), [*range(420), *range(580, 900)], ON, PLANNED_S),
        f"{SHORT} showed 140 of 300 recorded frames with beam (47 %), and at least 50 % are needed",
    ),
    "recorded less than delivered": (
        *(Service(on=range(300, 400)), [*range(400), *range(560, 900)], range(300, 400), PLANNED_S),
        "3.3 s of beam were recorded, and 10.0 s counted as delivered",
    ),
}


@pytest.mark.parametrize("name", VACUOUS)
def test_what_was_not_there_to_compare_is_named(tmp_path, name):
    service, frames, on, delivered_s, trouble = VACUOUS[name]
    fraction = report_of(service, seen(frames, on), tmp_path, delivered_s=delivered_s)
    assert trouble in fraction.all_troubles
    assert not fraction.is_good
    assert trouble in " ".join(text_of(fraction).split())


def test_a_session_that_was_killed_may_lack_its_last_second(tmp_path):
    service = Service(recorded=range(340), on=range(320, 340), status="interrupted")
    stretch = checked("s", seen(range(330), range(320, 340)), 0, service, tmp_path)
    assert stretch.troubles == ()


def test_a_fraction_without_a_session_or_a_beam_is_not_good():
    fraction = FractionReport(number=1, outcome="delivered", seconds=0.0, beams=(), stretches=())
    assert not fraction.is_good
    assert fraction.all_troubles == ("no session was run", "no beam was planned")


def test_a_report_of_no_fraction_is_not_good(tmp_path):
    write_report(tmp_path / "report.json", [], plan="P", chaos={})
    assert '"is_good": false' in (tmp_path / "report.json").read_text()


def test_the_command_fails_and_states_in_a_line_that_no_live_frame_was_received(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from lab.commands import simulate_tps
    from service.cli import app

    fraction = report_of(Service(), BeamClock(), tmp_path, delivered_s=0.0)
    monkeypatch.setattr(simulate_tps, "_client", lambda *_: None)
    monkeypatch.setattr(simulate_tps, "_prescription", lambda *_: SimpleNamespace(label="P"))
    monkeypatch.setattr(simulate_tps, "_calibration", lambda *_: "c")
    monkeypatch.setattr(simulate_tps, "_run", lambda *_, **__: SimpleNamespace(run=lambda: fraction))
    ran = CliRunner().invoke(app, ["simulate-tps", "--out", str(tmp_path)])
    assert ran.exit_code == 1, ran.output
    assert "fraction 1: no live frame was received" in ran.output.splitlines()
