"""The breath: figures where known, a dash and why where not; the hold with its clock; a drift that is confirmed."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import (
    BREATH,
    NOTHING_MEASURED,
    SESSION_ID,
    FakeService,
    breath_hold,
    condition,
    person,
    phase,
    sample,
    window,
)
from tests.support.browser.legibility import COUNT_COLOR
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NONE = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
FIGURES = ("rate", "amplitude", "regularity", "baseline", "drift", "drift-rate")
DRIFTED = sample(breath=BREATH | {"drift": 1.74})
BASELINE_RGB, EVENT_RGB, WINDOW_RGB = (201, 162, 255), (255, 157, 107), (232, 210, 122)


def show(fake: FakeService, tab: Tab, **changes: Any) -> Page:
    fake.mode, fake.sample = "samples", sample(**changes)
    return tab.open("hold")


def corrections(fake: FakeService) -> list[object]:
    return [body for path, body in fake.posts() if path == f"/sessions/{SESSION_ID}/baseline-correction"]


def test_what_is_known_of_the_breath_is_shown_with_sign(fake: FakeService, tab: Tab):
    page = show(fake, tab)
    shown = {name: page.locator(f"#figure-{name}") for name in FIGURES}
    expect(page.locator("#phase-value")).to_have_text("37 %")
    expect(page.locator("#phase-note")).to_have_text("phase, confidence 0.92")
    expect(shown["rate"]).to_have_text("15.0")
    expect(shown["amplitude"]).to_have_text("9.0")
    expect(shown["baseline"]).to_have_text(f"{MINUS}0.4")
    expect(shown["drift"]).to_have_text("+0.2")
    expect(shown["regularity"]).to_have_text("94 %")
    expect(page.locator("#breath-signal")).to_have_text("whole, mm")
    expect(page.locator("#phase-dot")).to_have_attribute("visibility", "visible")


def test_a_phase_that_is_not_known_states_why_and_the_ring_points_nowhere(fake: FakeService, tab: Tab):
    page = show(fake, tab, breath=BREATH | {"phase_percent": None, "phase_confidence": 0.0, "note": "a cough"})
    expect(page.locator("#phase-value")).to_have_text(NONE)
    expect(page.locator("#phase-note")).to_have_text("Phase unknown: a cough")
    expect(page.locator("#phase-dot")).to_have_attribute("visibility", "hidden")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (NOTHING_MEASURED | {"state": "lost"}, "Phase unknown: not measured"),
        ({"breath": None}, "Phase unknown: this signal has no breathing analysis"),
    ],
    ids=["lost", "not followed"],
)
def test_nothing_known_is_a_dash_and_never_quiet_breathing(fake: FakeService, tab: Tab, changes: dict, said: str):
    page = show(fake, tab, **changes)
    expect(page.locator("#phase-note")).to_have_text(said)
    for name in FIGURES:
        expect(page.locator(f"#figure-{name}")).to_have_text(NONE)
    expect(page.locator("#breath-events li")).to_have_count(0)
    expect(page.locator("#do-correct")).to_be_disabled()


def test_a_stream_that_stops_leaves_no_figure_of_the_breath(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(sample(window=window(breath_hold()), breath_hold=hold("held", 11.3)))
    stepped.advance(200)
    expect(page.locator("#hold-seconds")).to_have_text("11.3")
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    stepped.advance(200)
    for name in ("phase-value", "figure-rate", "hold-seconds", "hold-count", "hold-stage"):
        expect(page.locator(f"#{name}")).to_have_text(NONE)


def test_events_are_reported_in_words_with_time_and_confidence(fake: FakeService, tab: Tab):
    events = [
        {"kind": "apnoea", "confidence": 0.91, "since_s": 12.4, "detail": ""},
        {"kind": "drift", "confidence": 0.8, "since_s": 30.0, "detail": "0.2 mm/s"},
    ]
    page = show(fake, tab, breath=BREATH | {"events": events})
    rows = page.locator("#breath-events li")
    expect(rows).to_have_text(["No breath, 12 s · 91 % sure", "The baseline drifts, 30 s · 80 % sure · 0.2 mm/s"])
    expect(page.locator("#figure-drift")).to_have_attribute("data-bad", "yes")
    tab.await_that(lambda: page.evaluate(COUNT_COLOR, EVENT_RGB) > 100, "no event is drawn")


def hold(stage: str, seconds: float | None) -> dict[str, Any]:
    return {"hold": "inspiration", "stage": stage, "count": 2, "seconds": seconds, "settle_s": 1.0, "timeout_s": 25.0}


@pytest.mark.parametrize(
    ("stage", "seconds", "word", "clock", "bar"),
    [
        ("awaited", None, "Waiting for the breath hold", NONE, 0.0),
        ("settling", 0.6, "Keep still", "0.6", 0.6),
        ("held", 12.5, "Held", "12.5", 0.5),
        ("drifted", 1.2, "Drifted: breathe", "1.2", 0.0),
        ("over", 3.0, "Time limit reached: breathe", "3.0", 0.0),
    ],
)
def test_a_breath_hold_shows_its_stage_its_seconds_and_how_many(
    fake: FakeService, tab: Tab, stage: str, seconds: float | None, word: str, clock: str, bar: float
):
    page = show(fake, tab, window=window(breath_hold()), breath_hold=hold(stage, seconds))
    expect(page.locator("#hold-stage")).to_have_text(word)
    expect(page.locator("#hold-seconds")).to_have_text(clock)
    expect(page.locator("#hold-count")).to_have_text("2")
    assert page.locator("#hold-bar").evaluate("bar => bar.value") == pytest.approx(bar)


def test_a_window_without_a_breath_hold_shows_none(fake: FakeService, tab: Tab):
    page = show(fake, tab)
    expect(page.locator("#breath-hold")).to_be_hidden()


def test_the_window_drawn_is_the_settled_one_and_the_baseline_is_drawn(fake: FakeService, tab: Tab):
    page = show(fake, tab, window=window(condition(lower=2.5, upper=6.0)), breath=BREATH | {"baseline": 1.5})
    tab.await_that(lambda: page.evaluate(COUNT_COLOR, WINDOW_RGB) > 100, "no window is drawn")
    tab.await_that(lambda: page.evaluate(COUNT_COLOR, BASELINE_RGB) > 5, "no baseline is drawn")
    unsettled = condition(unit="percent", lower=0.0, upper=30.0, hysteresis=2.0)
    fake.sample = sample(window=window(unsettled), breath=None)
    page.reload()
    tab.sees("hold")
    tab.draws(fake, 20)
    assert page.evaluate(COUNT_COLOR, WINDOW_RGB) == 0, "per cent of a range that is not known are not drawn"
    assert page.evaluate(COUNT_COLOR, BASELINE_RGB) == 0


def test_a_window_on_the_volume_is_shown_in_litres(fake: FakeService, tab: Tab):
    volume = condition(signal="volume", label="volume", unit="l", lower=-0.05, upper=0.15, hysteresis=0.01)
    page = show(fake, tab, window=window(volume), signal_mm=None, volume_l=0.317)
    expect(page.locator("#trace-value")).to_have_text("0.32")
    expect(page.locator("#trace-unit")).to_have_text("l")
    expect(page.locator("#trace-name")).to_have_text("Gated on volume, \N{MINUS SIGN}0.05 to 0.15 l")


def test_all_conditions_are_named_beside_the_trace(fake: FakeService, tab: Tab):
    both = window(condition(), phase(signal="abdomen"), join="or")
    page = show(fake, tab, window=both)
    expect(page.locator("#trace-name")).to_have_text("Gated on whole, \N{MINUS SIGN}1.0 to 3.0 mm or abdomen, phase")


def test_a_drift_is_corrected_by_two_clicks_of_a_named_person_and_by_what_they_saw(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.person = "samples", DRIFTED, person("Ada L.")
    page = tab.open("hold")
    button = page.locator("#do-correct")
    expect(button).to_have_text("Correct baseline by +1.7 mm")
    button.click()
    expect(button).to_have_text("Confirm: shift the window by +1.7 mm? Disarms")
    assert corrections(fake) == []
    fake.sample = sample(breath=BREATH | {"drift": 2.3})
    tab.draws(fake)
    expect(page.locator("#figure-drift")).to_have_text("+2.3")
    expect(button).to_have_text("Confirm: shift the window by +1.7 mm? Disarms")
    button.click()
    expect(page.locator("#outcome")).to_have_text("Disarmed. The window was shifted.")
    assert corrections(fake) == [{"operator": "Ada L.", "by_mm": 1.7, "drift_mm": 1.74}]


def test_a_correction_that_is_not_confirmed_is_forgotten(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(DRIFTED)
    page.click("#do-correct")
    stepped.advance(5_400)
    expect(page.locator("#do-correct")).to_contain_text("Confirm")
    stepped.advance(800)
    expect(page.locator("#do-correct")).to_have_text("Correct baseline by +1.7 mm")
    assert corrections(fake) == []


def test_after_a_correction_only_what_is_left_of_the_drift_is_offered(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DRIFTED
    page = tab.open("hold")
    expect(page.locator("#do-correct")).to_be_enabled()
    fake.sample = sample(breath=BREATH | {"drift": 0.04}, window=window(condition(lower=0.7, upper=4.7)))
    expect(page.locator("#do-correct")).to_be_disabled()
    expect(page.locator("#do-correct")).to_have_text("Correct baseline")


def test_a_small_drift_and_a_phase_alone_offer_no_correction(fake: FakeService, tab: Tab):
    page = show(fake, tab)
    expect(page.locator("#do-correct")).to_be_disabled()
    fake.sample = DRIFTED | {"window": window(phase())}
    tab.draws(fake)
    expect(page.locator("#do-correct")).to_be_disabled()


def test_a_slow_answer_is_stated_in_colour(fake: FakeService, tab: Tab):
    page = show(fake, tab, latency_ms={"last": 131.0, "p50": 31.2, "p99": 96.0, "max": 131.0, "warned": True})
    expect(page.locator("#figure-latency")).to_have_text("131.0 · 31.2 · 96.0 · 131.0")
    expect(page.locator("#figure-latency")).to_have_attribute("data-bad", "yes")
    fake.sample = sample()
    expect(page.locator("#figure-latency")).to_have_attribute("data-bad", "no")
