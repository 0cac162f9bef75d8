"""The window is set on the patient's last minute: typed or dragged, with what it would have done."""

import random
import re
from itertools import pairwise

import pytest
from playwright.sync_api import Page, expect

from engine.gating.windows import WindowInput, amplitude_window, initial_states
from service.core.schemas.windows import Window
from tests.support.browser.fake_service import PROPOSAL, FakeService, breath_hold, phase, sample, window
from tests.support.browser.node import in_node
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab
from tests.support.gating.streams import motion_of

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
EXHALE = PROPOSAL | {"level": -1.0, "percent": 0.0}
INHALE = PROPOSAL | {"at": "end_inhale", "level": 9.0, "percent": 100.0}


def opened(fake: FakeService, tab: Tab, message: dict = DISARMED, proposals: tuple = (EXHALE, INHALE)) -> Page:
    fake.mode, fake.sample = "samples", message
    fake.sessions[0]["reference_proposals"] = list(proposals)
    page = tab.open(message["gate"])
    page.click("#do-window")
    expect(page.locator("#window-editor")).to_be_visible()
    return page


def windows(fake: FakeService) -> list[dict]:
    return [body for path, body in fake.posts() if path.endswith("/window")]


def test_per_cent_come_first_and_are_sent_as_typed(fake: FakeService, tab: Tab):
    page = opened(fake, tab)
    expect(page.locator("[name=unit]")).to_have_value("percent")
    expect(page.locator("#window-editor [name=lower]")).to_have_value("0")
    expect(page.locator("#window-editor [name=upper]")).to_have_value("40")
    page.fill("#window-editor [name=upper]", "30")
    page.fill("#window-editor [name=lower]", "-10")
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_have_text("Window set.")
    (body,) = windows(fake)
    assert body["operator"] == "A. Therapist"
    sent = body["window"]
    assert (sent["lower_percent"], sent["upper_percent"], sent["dwell_ms"]) == (-10, 30, 200)
    assert not {"lower_mm", "upper_mm", "hysteresis_mm"} & sent.keys()
    Window.model_validate(sent)
    expect(page.locator("#window-editor")).to_be_hidden()


def test_lengths_keep_the_session_s_hysteresis(fake: FakeService, tab: Tab):
    page = opened(fake, tab)
    page.select_option("[name=unit]", "mm")
    expect(page.locator("#window-editor [name=lower]")).to_have_value("-1.0")
    expect(page.locator("#window-editor [name=upper]")).to_have_value("3.0")
    page.fill("#window-editor [name=upper]", "2.5")
    page.fill("#window-editor [name=dwell_ms]", "300")
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_have_text("Window set.")
    sent = windows(fake)[0]["window"]
    assert (sent["lower_mm"], sent["upper_mm"], sent["hysteresis_mm"], sent["dwell_ms"]) == (-1, 2.5, 0.2, 300)


def test_without_a_learned_breath_the_edges_are_in_mm(fake: FakeService, tab: Tab):
    page = opened(fake, tab, proposals=())
    expect(page.locator("[name=unit]")).to_have_value("mm")
    page.select_option("[name=unit]", "percent")
    expect(page.locator("#window-forecast")).to_contain_text("The learned breath is not known")


def test_an_edge_is_dragged_on_the_trace(fake: FakeService, stepped: SteppedPage):
    fake.is_breathing = True
    fake.sessions[0]["reference_proposals"] = [EXHALE, INHALE]
    page = stepped.open_settled(DISARMED)
    page.click("#do-window")
    page.select_option("[name=unit]", "mm")
    box = page.locator("#trace").bounding_box()
    assert box is not None
    stepped.advance_until(lambda: page.get_attribute("#trace", "data-edges"))
    lower, upper = map(float, (page.get_attribute("#trace", "data-edges") or "").split())
    page.mouse.move(box["x"] + 300, box["y"] + upper)
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + upper - (lower - upper) / 2, steps=5)
    page.mouse.up()
    assert float(page.input_value("#window-editor [name=upper]")) == pytest.approx(5.0, abs=0.25)
    assert page.input_value("#window-editor [name=lower]") == "-1.0"


@pytest.mark.parametrize(
    ("change", "is_open"),
    [({"is_armed": True, "gate": "hold"}, False), ({"session_id": "99" * 16}, False), ({"hold_text": "Still"}, True)],
)
def test_it_closes_where_the_window_cannot_be_set(fake: FakeService, tab: Tab, change: dict, is_open: bool):
    page = opened(fake, tab)
    fake.sample = DISARMED | change
    tab.draws(fake)
    if is_open:
        expect(page.locator("#window-editor")).to_be_visible()
    else:
        expect(page.locator("#window-editor")).to_be_hidden()


def test_a_late_frame_leaves_it_open_and_applies_nothing(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.click("#do-window")
    page.fill("#window-editor [name=upper]", "2.5")
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    expect(page.locator("#window-editor")).to_be_visible()
    expect(page.locator("#window-apply")).to_be_disabled()
    expect(page.locator("#do-window")).to_be_disabled()
    page.press("#window-editor [name=upper]", "Enter")
    page.evaluate("document.querySelector('#window-editor').requestSubmit()")
    stepped.advance(400)
    assert windows(fake) == []
    fake.mode = "samples"
    stepped.advance_until(lambda: stepped.kind == "disarmed")
    expect(page.locator("#window-editor [name=upper]")).to_have_value("2.5")
    expect(page.locator("#window-apply")).to_be_enabled()


@pytest.mark.parametrize("change", [{"is_armed": True, "gate": "hold"}, {"session_id": "99" * 16}], ids=str)
def test_it_closes_after_a_gap_if_the_state_no_longer_allows_it(fake: FakeService, stepped: SteppedPage, change: dict):
    page = stepped.open_settled(DISARMED)
    page.click("#do-window")
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    fake.mode, fake.sample = "samples", DISARMED | change
    stepped.advance_until(lambda: stepped.kind != "stale")
    stepped.advance(400)
    expect(page.locator("#window-editor")).to_be_hidden()
    assert windows(fake) == []


def test_edges_that_are_no_window_are_not_sent(fake: FakeService, tab: Tab):
    page = opened(fake, tab)
    page.fill("#window-editor [name=upper]", "-20")
    expect(page.locator("#window-forecast")).to_have_text("The lower edge must be below the upper one.")
    expect(page.locator("#window-apply")).to_be_disabled()


def test_a_refusal_leaves_it_open_and_names_the_bound(fake: FakeService, tab: Tab):
    page = opened(fake, tab)
    fake.problem = (422, {"detail": "too wide", "field": "window.upper_mm", "value": "30", "bound": "at most 20"})
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_contain_text("at most 20")
    expect(page.locator("#window-editor")).to_be_visible()


def test_beyond_the_budget_it_asks_for_a_reason_and_sends_it(fake: FakeService, tab: Tab):
    page = opened(fake, tab)
    reason = page.locator("#window-editor [name=reason]")
    expect(reason).to_be_hidden()
    fake.problem = (409, {"code": "reference_distance", "detail": "10 mm beyond the fraction's first"})
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_contain_text("beyond the fraction's first")
    reason.fill("the plan was adapted")
    fake.problem = None
    page.click("#window-apply")
    expect(page.locator("#window-editor")).to_be_hidden()
    assert windows(fake)[-1]["reason"] == "the plan was adapted"


def test_other_conditions_stay_and_a_phase_alone_is_not_edited(fake: FakeService, tab: Tab):
    joined = {"kind": "phase", "signal": "whole", "from_percent": 30.0, "to_percent": 70.0, "min_confidence": 0.6}
    fake.sessions[0]["window"] = fake.sessions[0]["window"] | {"further": [joined]}
    page = opened(fake, tab, DISARMED | {"window": window(breath_hold(), phase())})
    expect(page.locator("#window-others")).to_have_text("Other conditions stay as they are.")
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_have_text("Window set.")
    assert windows(fake)[0]["window"]["further"] == [joined]
    fake.sample = DISARMED | {"window": window(phase())}
    expect(page.locator("#do-window")).to_be_disabled()


FORECAST = """
async ([samples, window, dwell]) => (await import('/js/stream/window_forecast.js')).forecast(samples, window, dwell)
"""


def gated(levels: list[float | None], step_s: float, lower: float, upper: float, dwell_s: float) -> list[bool]:
    """Judge levels by the gate's own window and a dwell: whether the beam is on after each."""
    condition, states = amplitude_window(lower_mm=lower, upper_mm=upper, hysteresis_mm=0.2), None
    inside_for, on = None, []
    for level in levels:
        if level is None:
            states, inside_for = None, None
            on.append(False)
            continue
        kept = initial_states(condition) if states is None else states
        verdict = condition.judge(WindowInput(motion_of(level), (), 0), kept)
        states = verdict.states
        inside_for = (0.0 if inside_for is None else inside_for + step_s) if verdict.is_inside else None
        on.append(inside_for is not None and inside_for >= dwell_s - 1e-9)
    return on


@pytest.mark.parametrize("seed", range(6))
def test_the_prediction_is_what_the_gate_s_own_window_does(seed: int):
    chance, step_s, dwell_s = random.Random(seed), 1 / 30, chance_dwell(seed)
    level, levels = 0.0, []
    for _ in range(1_500):
        level += chance.gauss(0.0, 0.35) - 0.03 * level
        levels.append(None if seed == 5 and chance.random() < 0.003 else level)
    on = gated(levels, step_s, -1.0, 1.5, dwell_s)
    samples = [{"t": i * step_s, "value": value} for i, value in enumerate(levels)]
    found = in_node(FORECAST, [samples, {"lower": -1.0, "upper": 1.5, "hysteresis": 0.2}, dwell_s])
    starts = sum(now and not before for before, now in pairwise([False, *on]))
    assert round(found["pulsesPerMin"] * found["seconds"] / 60) == starts
    measured = sum(value is not None for value in levels) * step_s
    assert found["percent"] == pytest.approx(100 * sum(on) * step_s / measured, abs=2.0)
    assert starts > 5, "a minute without pulses would prove nothing"


def chance_dwell(seed: int) -> float:
    return [0.0, 0.1, 0.2, 0.3, 0.5, 0.1][seed]


def test_short_pulses_are_marked(fake: FakeService, tab: Tab):
    fake.is_breathing, fake.period_s = True, 0.01
    page = opened(fake, tab)
    expect(page.locator("#window-forecast")).to_contain_text("pulses/min")
    page.fill("#window-editor [name=lower]", "50")
    page.fill("#window-editor [name=upper]", "60")
    page.fill("#window-editor [name=dwell_ms]", "0")
    expect(page.locator("#window-forecast")).to_have_attribute("data-short", "yes")


def test_a_breath_hold_s_band_is_taken_from_the_breath_that_is_held(fake: FakeService, tab: Tab):
    held = DISARMED | {"window": window(breath_hold()), "signal_mm": 12.4}
    page = opened(fake, tab, held)
    expect(page.locator("#window-held")).to_be_visible()
    page.wait_for_timeout(2_500)  # of samples that stand still
    page.click("#window-held")
    expect(page.locator("[name=unit]")).to_have_value("mm")
    expect(page.locator("#window-editor [name=lower]")).to_have_value("10.9")
    expect(page.locator("#window-editor [name=upper]")).to_have_value("13.9")
    fake.sample = held | {"signal_mm": 9.0}
    page.wait_for_timeout(300)
    page.fill("#window-editor [name=lower]", "10")
    page.click("#window-held")
    expect(page.locator("#window-forecast")).to_contain_text("Hold the breath still for 2 s: it moved by 3.4 mm")
    expect(page.locator("#window-editor [name=lower]")).to_have_value("10")


def test_a_breath_hold_is_not_armed_before_its_level_was_set(fake: FakeService, tab: Tab):
    """Review U6: millimetres were asked for before a breath was seen."""
    waits = breath_hold(lower=None, upper=None, hysteresis=None)
    page = opened(fake, tab, DISARMED | {"window": window(waits), "signal_mm": 12.4})
    expect(page.locator("#window-editor [name=lower]")).to_have_value("")
    expect(page.locator("#window-forecast")).to_contain_text("let the patient hold a breath")
    expect(page.locator("#window-apply")).to_be_disabled()
    page.click("#window-cancel")
    expect(page.locator("#do-arm")).to_have_attribute("title", re.compile("hold a breath"))
    expect(page.locator("#steps [data-code=window]")).not_to_have_attribute("data-state", "done")
    page.click("#do-window")
    page.wait_for_timeout(2_500)  # of samples that stand still
    page.click("#window-held")
    page.click("#window-apply")
    expect(page.locator("#outcome")).to_have_text("Window set.")
    sent = windows(fake)[-1]["window"]
    assert (sent["lower_mm"], sent["upper_mm"]) == (10.9, 13.9)


def test_other_windows_take_no_band_from_a_held_breath(fake: FakeService, tab: Tab):
    expect(opened(fake, tab).locator("#window-held")).to_be_hidden()
