"""Windows of every kind over HTTP: accepted ones reach the engine as requested, others are refused by field."""

import pytest
from pydantic import ValidationError

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.signals import LearnedRange
from engine.gating.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    ConditionState,
    HoldStage,
    JoinedWindow,
    PhaseWindow,
)
from engine.motion.settings import PipelineSettings
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.site_limits.window_limits import (
    breath_signals,
    check_window,
    gate_limits,
    gate_window,
    measuring_with,
)
from service.sessions.views.breath import live_window
from tests.support.service.api_calls import WINDOW, act, make_session_body
from tests.support.service.clinical_site import clinical_settings
from tests.support.service.fake_engine import make_measurement

pytestmark = pytest.mark.slow

URL = "/api/v1/sessions"
MM = {"lower_mm": -1.0, "upper_mm": 3.0}
BELLY = {"name": "belly", "vertices": [[220.0, 40.0], [220.0, 160.0], [320.0, 100.0]]}
CHEST = {"name": "chest", "vertices": [[20.0, 40.0], [20.0, 160.0], [120.0, 100.0]]}
REGIONS = sessions.Regions.model_validate({"named": [CHEST, BELLY]})
HOLD = {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0}
PHASE = {"kind": "phase", "from_percent": 30.0, "to_percent": 70.0}

TAKEN = [
    (WINDOW, AmplitudeWindow(lower=-1.0, upper=3.0, hysteresis=0.2)),
    (MM, AmplitudeWindow(lower=-1.0, upper=3.0, hysteresis=0.2)),
    (
        {"lower_percent": 0, "upper_percent": 30, "hysteresis_percent": 0},
        AmplitudeWindow(lower=0, upper=30, hysteresis=0, unit="percent"),
    ),
    (
        {"signal": "volume", "lower_l": -0.1, "upper_l": 0.2},
        AmplitudeWindow(choice=SignalChoice(signal="volume"), lower=-0.1, upper=0.2, hysteresis=0.01, unit="l"),
    ),
    (
        {"signal": "volume", "lower_percent": 0, "upper_percent": 20},
        AmplitudeWindow(choice=SignalChoice(signal="volume"), lower=0, upper=20, hysteresis=2, unit="percent"),
    ),
    (
        {"signal": "region", "row": 13, "column": 7, **MM},
        AmplitudeWindow(choice=SignalChoice(signal="region", row=13, column=7), lower=-1.0, upper=3.0, hysteresis=0.2),
    ),
    (
        {"signal": "point", "row": 349, "column": 199, **MM},
        AmplitudeWindow(
            choice=SignalChoice(signal="point", row=349, column=199), lower=-1.0, upper=3.0, hysteresis=0.2
        ),
    ),
    (
        {"signal": "named", "name": "belly", **MM},
        AmplitudeWindow(
            choice=SignalChoice(signal="named", name="belly", index=1), lower=-1.0, upper=3.0, hysteresis=0.2
        ),
    ),
    (HOLD, BreathHoldWindow(level=AmplitudeWindow(lower=8.0, upper=12.0, hysteresis=0.2))),
    (
        HOLD | {"hold": "expiration", "settle_ms": 500, "still_mm": 0.5, "max_drift_mm": 1.5, "timeout_s": 12},
        BreathHoldWindow(
            level=AmplitudeWindow(lower=8.0, upper=12.0, hysteresis=0.2),
            kind="expiration",
            settle_ms=500,
            still=0.5,
            max_drift=1.5,
            timeout_s=12,
        ),
    ),
    (
        {"kind": "breath_hold", "signal": "volume", "lower_l": 0.8, "upper_l": 1.2, "still_l": 0.07},
        BreathHoldWindow(
            level=AmplitudeWindow(
                choice=SignalChoice(signal="volume"), lower=0.8, upper=1.2, hysteresis=0.01, unit="l"
            ),
            still=0.07,
            max_drift=0.1,
        ),
    ),
    (
        {"kind": "breath_hold"},
        BreathHoldWindow(level=AmplitudeWindow(lower=0, upper=100, unit="percent"), is_level_set=False),
    ),
    (PHASE, PhaseWindow(from_percent=30.0, to_percent=70.0)),
    (
        PHASE | {"from_percent": 90, "to_percent": 10, "min_confidence": 0.8, "signal": "abdomen"},
        PhaseWindow(choice=SignalChoice(signal="abdomen"), from_percent=90, to_percent=10, min_confidence=0.8),
    ),
    (
        {**MM, "join": "or", "further": [PHASE, HOLD]},
        JoinedWindow(
            conditions=(
                AmplitudeWindow(lower=-1.0, upper=3.0, hysteresis=0.2),
                PhaseWindow(from_percent=30.0, to_percent=70.0),
                BreathHoldWindow(level=AmplitudeWindow(lower=8.0, upper=12.0, hysteresis=0.2)),
            ),
            join="or",
        ),
    ),
]


@pytest.mark.parametrize(("body", "made"), TAKEN, ids=lambda part: str(part)[:40])
def test_every_kind_of_window_reaches_the_engine_as_requested(body, made):
    window = Window.model_validate(body)
    assert gate_window(window, REGIONS) == made
    again = Window.model_validate_json(window.model_dump_json())
    assert again == window, "what was stored, or sent back by a client, is the same window"


def test_every_kind_of_window_makes_a_session_and_is_returned(client, session_body, subtests):
    for body, _ in TAKEN:
        with subtests.test(str(body)):
            answer = client.post(URL, json=session_body | {"window": body, "regions": {"named": [CHEST, BELLY]}})
            assert answer.status_code == 201, answer.text
            shown = answer.json()["window"]
            assert {name: shown[name] for name in body if name != "further"} == {
                name: value for name, value in body.items() if name != "further"
            }
            assert act(client, answer.json()["id"], "stop").status_code == 200


def further(**changes):
    return MM | {"further": [MM, MM | changes]}


REFUSED = [
    ({}, "window.lower_mm"),
    ({"lower_mm": 1.0}, "window.upper_mm"),
    ({"upper_mm": 1.0}, "window.lower_mm"),
    (MM | {"lower_percent": 0}, "window.lower_percent"),
    (MM | {"upper_l": 0.3}, "window.upper_l"),
    (MM | {"hysteresis_percent": 3}, "window.hysteresis_percent"),
    ({"lower_l": 0.1, "upper_l": 0.2}, "window.lower_l"),
    ({"signal": "volume", **MM}, "window.lower_mm"),
    ({"lower_percent": 30, "upper_percent": 30}, "window.lower_percent"),
    ({"lower_percent": -101, "upper_percent": 30}, "window.lower_percent"),
    ({"lower_percent": 0, "upper_percent": 301}, "window.upper_percent"),
    ({"lower_percent": 0, "upper_percent": 3}, "window.hysteresis_percent"),
    ({"signal": "volume", "lower_l": -21, "upper_l": 0}, "window.lower_l"),
    ({"kind": "magic", **MM}, "window.kind"),
    ({"kind": ["phase"], **MM}, "window.kind"),
    ({"signal": "named", **MM}, "window.name"),
    ({"signal": "named", "name": "liver", **MM}, "window.name"),
    ({"signal": "named", "name": "../x", **MM}, "window.name"),
    ({"name": "belly", **MM}, "window.name"),
    ({"signal": "region", "row": 14, "column": 0, **MM}, "window.row"),
    ({"signal": "region", "row": 0, "column": 8, **MM}, "window.column"),
    ({"signal": "point", "row": 350, "column": 8, **MM}, "window.row"),
    ({"signal": "point", "row": 1, **MM}, "window.column"),
    (MM | {"settle_ms": 500}, "window.settle_ms"),
    (MM | {"from_percent": 5}, "window.from_percent"),
    (HOLD | {"settle_ms": 99}, "window.settle_ms"),
    (HOLD | {"timeout_s": 121}, "window.timeout_s"),
    (HOLD | {"still_mm": 0.0}, "window.still_mm"),
    (HOLD | {"max_drift_mm": 21}, "window.max_drift_mm"),
    (HOLD | {"still_l": 0.1}, "window.still_l"),
    (HOLD | {"hold": "both"}, "window.hold"),
    (HOLD | {"min_confidence": 0.5}, "window.min_confidence"),
    ({"kind": "breath_hold", "hysteresis_mm": 0.2}, "window.lower_mm"),
    ({"kind": "breath_hold", "upper_mm": 12.0}, "window.lower_mm"),
    (PHASE | MM, "window.lower_mm"),
    (PHASE | {"to_percent": 30}, "window.to_percent"),
    (PHASE | {"to_percent": 101}, "window.to_percent"),
    (PHASE | {"min_confidence": 0.05}, "window.min_confidence"),
    ({"kind": "phase", "to_percent": 30}, "window.from_percent"),
    (MM | {"min_on_ms": -1}, "window.min_on_ms"),
    (MM | {"min_off_ms": 60_001}, "window.min_off_ms"),
    (MM | {"max_cycles_per_min": 0}, "window.max_cycles_per_min"),
    (MM | {"max_cycles_per_min": 30.5}, "window.max_cycles_per_min"),
    (MM | {"join": "xor"}, "window.join"),
    (MM | {"further": [MM] * 4}, "window.further"),
    (MM | {"further": [{**MM, "dwell_ms": 10}]}, "window.further.0.dwell_ms"),
    (MM | {"further": [{**MM, "further": []}]}, "window.further.0.further"),
    (further(upper_mm=-1.0), "window.further.1.lower_mm"),
    (further(hysteresis_mm=2.0), "window.further.1.hysteresis_mm"),
    (further(signal="region", row=2), "window.further.1.column"),
    (further(signal="named", name="liver"), "window.further.1.name"),
    (further(surprise=1), "window.further.1.surprise"),
]


def test_a_window_that_is_none_is_refused_by_its_field(client, session_body, subtests):
    for body, field in REFUSED:
        with subtests.test(str(body)):
            answer = client.post(URL, json=session_body | {"window": body, "regions": {"named": [BELLY]}})
            assert answer.status_code == 422, answer.text
            problem = answer.json()
            assert problem["field"] == field
            assert problem["value"]
            assert problem["bound"]
    assert client.get(URL).json()["items"] == []


HELD_LITRES = {"kind": "breath_hold", "signal": "volume", "lower_l": 0.8, "upper_l": 1.2}


@pytest.mark.parametrize(
    ("name", "allowed", "refused"), [("still_mm", 2.0, 2.01), ("max_drift_mm", 3.0, 3.01), ("settle_ms", 500.0, 499.0)]
)
@pytest.mark.parametrize("settings", [Settings(), clinical_settings(window_upper_mm=40.0)], ids=["usual", "clinical"])
def test_a_breath_hold_that_need_not_be_held_is_refused_with_the_usual_limits(settings, name, allowed, refused):
    check_window(Window.model_validate(HOLD | {name: allowed}), settings)
    with pytest.raises(BoundError, match="this site's limit") as caught:
        check_window(Window.model_validate(HOLD | {name: refused}), settings)
    assert caught.value.field == f"window.{name}"


@pytest.mark.parametrize(
    ("site", "body", "field"),
    [
        ({"window_upper_mm": 11.0}, HOLD, "window.upper_mm"),
        ({"window_upper_mm": 11.0}, MM | {"further": [PHASE, HOLD]}, "window.further.1.upper_mm"),
        ({"window_lower_mm": 0.0}, HOLD | {"further": [MM]}, "window.further.0.lower_mm"),
        ({"max_breath_hold_s": 24.0}, HOLD, "window.timeout_s"),
        ({"max_hold_still_mm": 0.99}, HOLD, "window.still_mm"),
        ({"max_hold_drift_mm": 1.99}, HOLD, "window.max_drift_mm"),
        ({"min_hold_settle_ms": 1001.0}, MM | {"further": [HOLD]}, "window.further.0.settle_ms"),
        ({"max_hold_still_mm": 0.49}, HELD_LITRES, "window.still_l"),
        ({"max_hold_drift_mm": 0.99}, HELD_LITRES, "window.max_drift_l"),
        ({"max_breath_hold_s": 20.0}, MM | {"further": [HOLD | {"timeout_s": 21}]}, "window.further.0.timeout_s"),
        ({"min_dwell_ms": 300.0}, PHASE, "window.dwell_ms"),
        ({"min_phase_confidence": 0.61}, PHASE, "window.min_confidence"),
        ({"min_phase_confidence": 0.9}, MM | {"further": [PHASE]}, "window.further.0.min_confidence"),
        ({"min_on_ms": 300.0}, MM | {"min_on_ms": 299.0}, "window.min_on_ms"),
        ({"min_off_ms": 1000.0}, MM | {"min_off_ms": 999.0}, "window.min_off_ms"),
        ({"max_cycles_per_min": 30}, MM | {"max_cycles_per_min": 31}, "window.max_cycles_per_min"),
    ],
    ids=str,
)
def test_no_part_of_a_window_is_wider_than_the_site_s(site, body, field):
    settings = Settings(**site)
    with pytest.raises(BoundError, match="this site's limit") as caught:
        check_window(Window.model_validate(body), settings)
    assert caught.value.field == field
    check_window(Window.model_validate(body), Settings())


LITRES = {"signal": "volume", "lower_l": -0.1, "upper_l": 0.2}
IN_PER_CENT = {"signal": "abdomen", "lower_percent": 0, "upper_percent": 30}
SITE = {"window_lower_mm": -5.0, "window_upper_mm": 20.0}
WAYS_AROUND = [
    (PHASE, "window.kind"),
    (LITRES, "window.signal"),
    (HELD_LITRES, "window.signal"),
    ({"signal": "volume", "lower_percent": 0, "upper_percent": 30}, "window.signal"),
    (PHASE | {"signal": "volume"}, "window.kind"),
    (PHASE | {"further": [LITRES]}, "window.kind"),
    (LITRES | {"further": [PHASE, HELD_LITRES]}, "window.signal"),
    (MM | {"join": "or", "further": [PHASE]}, "window.further.0.kind"),
    (MM | {"join": "or", "further": [HOLD, LITRES]}, "window.further.1.signal"),
    (PHASE | {"join": "or", "further": [MM]}, "window.kind"),
]


@pytest.mark.parametrize(("body", "field"), WAYS_AROUND, ids=lambda part: str(part)[:60])
@pytest.mark.parametrize("site", [SITE, {"window_lower_mm": -99.0}, {"window_upper_mm": 99.0}], ids=str)
def test_no_window_is_a_way_around_the_site_s(site, body, field):
    with pytest.raises(BoundError, match="bounds no position") as caught:
        check_window(Window.model_validate(body), Settings(**site))
    assert caught.value.field == field
    check_window(Window.model_validate(body), Settings())


@pytest.mark.parametrize(
    "body",
    [
        MM,
        HOLD,
        IN_PER_CENT,
        HOLD | {"signal": "thorax"},
        MM | {"further": [PHASE, LITRES]},
        PHASE | {"further": [LITRES, IN_PER_CENT]},
        MM | {"join": "or", "further": [HOLD, IN_PER_CENT]},
    ],
    ids=lambda part: str(part)[:60],
)
def test_a_window_that_bounds_a_length_wherever_it_is_met_is_within_the_site_s(body):
    check_window(Window.model_validate(body), Settings(**SITE))


@pytest.mark.parametrize("holding", [("apnoea",), ("irregular", "sigh", "talking", "no_cycle"), ("cough", "drift")])
def test_a_breath_is_held_whatever_breathing_events_the_site_holds_the_beam_for(holding):
    """The gate does not judge those that a breath hold resembles: tests/engine/gating/test_bad_frames.py."""
    settings = Settings(holding_events=holding)
    check_window(Window.model_validate(HOLD), settings)
    assert gate_limits(Window.model_validate(HOLD), settings).holding_events == set(holding)


def test_how_often_the_beam_may_switch_is_the_site_s_unless_the_session_is_stricter():
    settings = Settings(min_on_ms=300.0, min_off_ms=1000.0, max_cycles_per_min=30)
    site = gate_limits(Window.model_validate(MM), settings)
    assert (site.min_on_ms, site.min_off_ms, site.max_cycles_per_min) == (300.0, 1000.0, 30)
    stricter = {"min_on_ms": 400.0, "min_off_ms": 2000.0, "max_cycles_per_min": 10}
    own = gate_limits(Window.model_validate(MM | stricter), settings)
    assert (own.min_on_ms, own.min_off_ms, own.max_cycles_per_min) == (400.0, 2000.0, 10)


@pytest.mark.parametrize(
    ("is_allowed", "is_calibrated", "may"), [(True, False, True), (False, False, False), (False, True, True)]
)
def test_a_camera_without_calibration_is_gated_only_where_the_site_states_it(is_allowed, is_calibrated, may):
    settings = Settings(beam_without_calibration=is_allowed)
    limits = gate_limits(Window.model_validate(MM), settings, is_calibrated=is_calibrated)
    assert limits.is_calibrated is may


def test_a_region_that_the_session_does_not_have_is_refused_with_those_it_has():
    window = Window.model_validate(MM | {"further": [MM | {"signal": "named", "name": "liver"}]})
    with pytest.raises(BoundError) as caught:
        gate_limits(window, Settings(), REGIONS)
    assert caught.value.field == "window.further.0.name"
    assert caught.value.bound == "one of the session's own regions: chest, belly"


def test_the_points_of_a_window_are_measured_and_found_by_their_place():
    first = MM | {"signal": "point", "row": 100, "column": 50}
    second = MM | {"signal": "point", "row": 200, "column": 60}
    window = Window.model_validate(first | {"further": [second, first]})
    settings = measuring_with(PipelineSettings(points=((7, 7), (200, 60))), sessions.Regions(), window)
    assert settings.points == ((100, 50), (200, 60), (7, 7))
    places = ((100, 50), (200, 60))
    assert settings.breath_signals == tuple(
        SignalChoice(signal="point", row=row, column=column, index=index) for index, (row, column) in enumerate(places)
    )
    choices = [condition.choice for condition in gate_window(window).leaves]
    assert [settings.points[choice.index] for choice in choices] == [(100, 50), (200, 60), (100, 50)]


def test_the_breath_of_the_first_signal_and_of_every_amplitude_and_phase_is_followed():
    belly = PHASE | {"signal": "named", "name": "belly"}
    window = Window.model_validate(
        {"signal": "thorax", **MM, "further": [MM | {"signal": "volume"} | VOLUME, belly, HOLD | {"signal": "abdomen"}]}
    )
    followed = (
        SignalChoice(signal="thorax"),
        SignalChoice(signal="volume"),
        SignalChoice(signal="named", name="belly", index=1),
    )
    assert breath_signals(window, REGIONS) == followed
    assert measuring_with(PipelineSettings(), REGIONS, window).breath_signals == followed
    assert set(followed) <= set(gate_window(window, REGIONS).choices), "the gate finds a breath by the very same signal"


VOLUME = {"lower_mm": None, "upper_mm": None, "lower_l": 0.1, "upper_l": 0.2}


def test_the_live_window_is_the_one_the_gate_judges_by_and_states_where_each_condition_stands():
    body = Window.model_validate(
        {"lower_percent": 0, "upper_percent": 50, "further": [PHASE, HOLD | {"hold": "inspiration"}]}
    )
    settled = gate_window(body).resolved({SignalChoice(): LearnedRange(low=-1.0, high=9.0)})
    states = (ConditionState(), ConditionState(), ConditionState(stage=HoldStage.SETTLING, since_us=33_370))
    shown = live_window(settled, states, make_measurement(1, whole_mm=1.5))
    assert (shown.lower_mm, shown.upper_mm, shown.hysteresis_mm, shown.join) == (-1.0, 4.0, 0.2, "and")
    first, phase, hold = shown.conditions
    assert (first.unit, first.lower, first.upper, first.is_inside, first.stage) == ("mm", -1.0, 4.0, True, None)
    assert (phase.kind, phase.from_percent, phase.to_percent, phase.lower, phase.unit) == ("phase", 30, 70, None, None)
    assert (hold.kind, hold.stage, hold.is_inside, hold.timeout_s) == ("breath_hold", "settling", False, 25.0)


def test_a_frame_that_was_not_measured_meets_nothing():
    window = gate_window(Window.model_validate(MM))
    states = (ConditionState(is_inside=True),)
    assert live_window(window, states, make_measurement(1, whole_mm=1.5)).conditions[0].is_inside
    for missing in (None, make_measurement(1, whole_mm=None)):
        assert not live_window(window, states, missing).conditions[0].is_inside


def test_a_window_that_is_not_settled_shows_per_cent_and_no_mm():
    shown = live_window(gate_window(Window.model_validate({"lower_percent": 0, "upper_percent": 50})))
    assert (shown.lower_mm, shown.conditions[0].unit, shown.conditions[0].upper) == (None, "percent", 50)


def test_the_engine_has_the_last_word(monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise InvalidValueError("still", 3.0, "something only the engine knows")

    monkeypatch.setattr("service.core.schemas.windows.BreathHoldWindow", refuse)
    with pytest.raises(ValidationError, match="still_mm must be something only the engine knows"):
        Window.model_validate(HOLD)


def test_the_window_of_today_stays_what_it_was(client, calibration_id):
    answer = client.post(URL, json=make_session_body(calibration_id))
    shown = answer.json()["window"]
    assert {name: shown[name] for name in WINDOW} == WINDOW
    body = {name for name, value in shown.items() if value not in (None, [])}
    assert body == {*WINDOW, "kind", "join"}
