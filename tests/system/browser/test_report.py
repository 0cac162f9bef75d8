"""After the end a summary; after a crash the page says whose session it was and what was delivered, and offers more."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from service.core.schemas.plans import PlanSessionRequest
from service.core.schemas.sessions import SessionRequest
from tests.support.browser.fake_service import SESSION, SESSION_ID, FakeService, over, person, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

MODEL = "4d" * 16
REPORT, HEADING, OFFER = "#report", "#report-heading", "#report-continue"


def opened(fake: FakeService, tab: Tab, session: dict[str, Any], *, models: tuple[str, ...] = (MODEL,)) -> Page:
    fake.mode, fake.sessions[:] = "idle", [session]
    fake.models = [{"id": one} for one in models]
    page = tab.open("idle")
    expect(page.locator(REPORT)).to_be_visible()
    return page


def created(fake: FakeService) -> list[dict[str, Any]]:
    return [body for path, body in fake.posts() if path == "/sessions"]


def test_the_end_of_a_session_shows_its_figures(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    fake.mode, fake.sessions[:] = "idle", [over()]
    expect(page.locator(HEADING)).to_have_text("Summary: P-0117")
    figures = page.locator("#report-figures")
    for text in ("41.2 s", "38 %", "3:07 min", "5400", "41 · 3", "5 · 9 · 31"):
        expect(figures).to_contain_text(text)
    expect(page.locator("#report-holds li").first).to_have_text("34 Outside the window")
    expect(page.locator("#report-when")).to_contain_text("PLAN-LUNG-4, fraction FX-03 (no. 3)")
    expect(page.locator(OFFER)).to_be_hidden()
    page.reload()
    page.click("#setup-close")
    expect(page.locator(HEADING)).to_have_text("Summary: P-0117")


def test_it_stays_until_a_session_is_chosen_or_runs_or_it_is_closed(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over())
    page.click("#setup-close")
    fake.sessions.insert(0, SESSION | {"id": "77" * 16, "status": "created"})
    expect(page.locator(REPORT)).to_be_hidden()
    assert page.locator("#report-figures").inner_text() == ""
    fake.sessions.pop(0)
    expect(page.locator(REPORT)).to_be_visible()
    fake.mode, fake.sample = "samples", sample(session_id="99" * 16)
    expect(page.locator(REPORT)).to_be_hidden()
    fake.mode = "idle"
    expect(page.locator(REPORT)).to_be_visible()
    page.click("#report-close")
    expect(page.locator(REPORT)).to_be_hidden()
    tab.is_answered()
    page.wait_for_timeout(2_000)
    expect(page.locator(REPORT)).to_be_hidden()


def test_a_log_out_removes_it(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted"))
    page.click("#do-log-out")
    expect(page.locator(REPORT)).to_be_hidden()
    for name in (HEADING, "#report-figures", "#report-when"):
        expect(page.locator(name)).to_have_text("")


def test_an_interrupted_session_is_announced_before_anything_else(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted", status_detail="the service ended while this session ran"))
    expect(page.locator(HEADING)).to_have_text("Interrupted: P-0117")
    expect(page.locator("#report-when")).to_contain_text("the service ended while this session ran")
    expect(page.locator("#report-note")).to_contain_text("Up to the last second")
    expect(page.locator("#setup")).to_be_hidden()
    expect(page.locator(OFFER)).to_have_text("Continue with its model")


def test_an_open_set_up_gives_way_to_an_interruption_and_to_the_end_of_what_ran_here(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    tab.open_setup()
    fake.mode, fake.sessions[:] = "idle", [over()]
    expect(page.locator(HEADING)).to_have_text("Summary: P-0117")
    expect(page.locator("#setup")).to_be_hidden()
    page.click("#do-setup")
    page.fill("[name=patient_reference]", "P-0118")
    fake.sessions[:] = [over("interrupted", id="99" * 16)]
    expect(page.locator(HEADING)).to_have_text("Interrupted: P-0117")
    expect(page.locator("#setup")).to_be_hidden()


@pytest.mark.parametrize("status", ["interrupted", "failed"])
def test_it_is_continued_with_its_model_and_nothing_is_armed(fake: FakeService, tab: Tab, status: str):
    page = opened(fake, tab, over(status))
    page.dblclick(OFFER)
    expect(page.locator("#gate-word")).to_have_text("Ready")
    (body,) = created(fake)
    assert (body["continues"], body["model_id"]) == (SESSION_ID, MODEL)
    request = SessionRequest.model_validate(body)
    assert (request.patient_reference, request.fraction_id, request.fraction_number) == ("P-0117", "FX-03", 3)
    assert request.window.lower_mm == -1.0
    expect(page.locator(REPORT)).to_be_hidden()
    assert not [path for path, _ in fake.posts() if path.endswith(("/arm", "/reference", "/start"))]


def test_a_session_from_a_plan_is_continued_from_it(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted", rt_plan_id="9a" * 16))
    page.click(OFFER)
    expect(page.locator("#gate-word")).to_have_text("Ready")
    ((path, body),) = [(path, body) for path, body in fake.posts() if path.endswith("/sessions")]
    assert path == f"/plans/{'9a' * 16}/sessions"
    request = PlanSessionRequest.model_validate(body)
    assert (request.continues, request.model_id) == (SESSION_ID, MODEL)
    assert request.repeats_fraction is not None


def test_without_a_model_it_states_that_it_trains_again(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted"), models=())
    expect(page.locator(OFFER)).to_have_text("Continue, training again")
    page.click(OFFER)
    expect(page.locator("#gate-word")).to_have_text("Ready")
    assert "model_id" not in created(fake)[0]


def test_a_refusal_is_stated_and_the_offer_stays(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted"))
    fake.problem = (422, {"detail": "continues must be a session that none continues", "field": "continues"})
    page.click(OFFER)
    expect(page.locator("#report-outcome")).to_contain_text("none continues")
    expect(page.locator(OFFER)).to_be_enabled()


def test_who_may_not_create_sessions_is_reported_and_offered_nothing(fake: FakeService, tab: Tab):
    fake.person = person("V. Viewer", Role.VIEWER)
    page = opened(fake, tab, over("interrupted"))
    expect(page.locator(OFFER)).to_be_disabled()
    expect(page.locator(OFFER)).to_have_attribute("title", "your log-in (viewer) does not allow it")


def test_a_continuation_that_was_stopped_before_it_started_hides_nothing(fake: FakeService, tab: Tab):
    fake.mode = "idle"
    never = SESSION | {"id": "77" * 16, "status": "stopped"}
    fake.sessions[:] = [never, over("interrupted")]
    page = tab.open("idle")
    expect(page.locator(HEADING)).to_have_text("Interrupted: P-0117")


def test_it_covers_neither_gate_nor_trace_nor_hold(fake: FakeService, tab: Tab):
    page = opened(fake, tab, over("interrupted"))
    panel = page.locator(REPORT).bounding_box()
    assert panel is not None
    for name in ("#gate", ".panel.trace", "#do-disarm", "#do-hold"):
        box = page.locator(name).bounding_box()
        assert box is not None
        apart = panel["y"] >= box["y"] + box["height"] or panel["x"] >= box["x"] + box["width"]
        assert apart, f"{name} is covered"
