"""``tidegate measure --window``: which signals it takes, in which unit, and what it says of others."""

import pytest

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError, RecordingError
from engine.gating.limits import HYSTERESIS
from engine.gating.windows import AmplitudeWindow, Unit
from engine.motion.named_regions import NamedRegion
from engine.motion.settings import PipelineSettings
from service.cli.measure import command
from service.cli.measure.options import window
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.site_limits.window_limits import gate_limits
from tests.support.command_line import invoke, measured

pytestmark = pytest.mark.verification

POINTS = ((10, 20), (30, 40))
NAMED = tuple(
    NamedRegion(name=name, vertices=((20.0, 40.0), (20.0, 160.0), (120.0, 100.0))) for name in ("chest", "belly")
)


@pytest.mark.parametrize(
    ("text", "choice", "unit"),
    [
        ("whole:-1:3", SignalChoice(), "mm"),
        ("abdomen:-1:3", SignalChoice(signal="abdomen"), "mm"),
        ("volume:-0.1:0.2", SignalChoice(signal="volume"), "l"),
        ("p30_40:-1:3", SignalChoice(signal="point", row=30, column=40, index=1), "mm"),
        ("belly:-1:3", SignalChoice(signal="named", name="belly", index=1), "mm"),
    ],
)
def test_every_signal_that_is_measured_can_be_gated_on(text, choice, unit):
    _, lower, upper = text.split(":")
    made = AmplitudeWindow(
        choice=choice, lower=float(lower), upper=float(upper), unit=unit, hysteresis=HYSTERESIS[Unit(unit)]
    )
    assert window(text, POINTS, NAMED) == made


@pytest.mark.parametrize("text", ["p1_2:0:1", "liver:0:1", "region:0:1", "point:0:1", "named:0:1", ":0:1"])
def test_a_signal_that_is_not_measured_is_refused_with_those_that_are(text):
    with pytest.raises(InvalidValueError, match="whole, thorax, abdomen, volume, p10_20, p30_40, chest, belly"):
        window(text, POINTS, NAMED)


@pytest.mark.parametrize(
    ("text", "field"), [("volume:0:30", "upper_l"), ("whole:3:-1", "upper_mm"), ("whole:1", "window")]
)
def test_edges_are_bounded_in_their_own_unit(text, field):
    with pytest.raises(InvalidValueError) as caught:
        window(text)
    assert caught.value.field == field


SERVICE_WINDOWS = {
    "whole:-1:3": {"lower_mm": -1.0, "upper_mm": 3.0},
    "volume:-0.1:0.2": {"signal": "volume", "lower_l": -0.1, "upper_l": 0.2},
}


@pytest.mark.parametrize("text", SERVICE_WINDOWS)
def test_the_limits_are_those_of_a_session_with_the_defaults_of_the_service(text, tmp_path, monkeypatch):
    tasks = []

    def refuse(task, **_options):
        tasks.append(task)
        raise RecordingError("not measured")

    monkeypatch.setattr(command, "_measure", refuse)
    invoke(tmp_path, tmp_path / "out", "--window", text)
    service = gate_limits(Window.model_validate(SERVICE_WINDOWS[text]), Settings.model_construct())
    assert tasks[0].limits == service


def test_the_settings_of_the_measurement_are_the_defaults_of_the_service(tmp_path, monkeypatch):
    tasks = []
    monkeypatch.setattr(command, "_measure", lambda task, **_options: tasks.append(task) or 1 / 0)
    invoke(tmp_path, tmp_path / "out")
    settings = Settings.model_construct()
    assert tasks[0].settings == PipelineSettings(training=settings.training, likeness=settings.likeness)


def test_the_predicted_duty_cycle_of_the_window_is_stated(measured_twice):
    percent = measured_twice.summary["predicted_duty_percent"]
    inside = [-1.0 <= float(row["whole_mm"]) <= 3.0 for row in measured_twice.rows]
    assert percent == pytest.approx(100.0 * sum(inside) / len(inside), abs=15.0)
    assert f"Predicted duty cycle of the window: {percent:.0f} %. " in measured_twice.said
    assert measured_twice.summary["duty_refusal"] is None
    assert "would not be armed with this window" not in measured_twice.said


def test_a_window_that_the_learned_breaths_never_leave_is_noted_as_a_session_refuses_it(
    regular_volunteer, measured_twice, tmp_path
):
    model = ("--single-pass", "--model", str(measured_twice.out / "model.npz"), "--patient", "P-0001")
    wide = measured(regular_volunteer, tmp_path / "wide", "--window", "whole:-100:100", *model)
    assert wide.summary["predicted_duty_percent"] == 100.0
    assert "100 % of the learned breaths lie inside, and at most 90 % may" in wide.summary["duty_refusal"]
    assert "Note: a session would not be armed with this window: window is" in wide.said
    without = measured(regular_volunteer, tmp_path / "without", *model)
    assert without.summary["predicted_duty_percent"] is None
    assert "duty cycle" not in without.said
