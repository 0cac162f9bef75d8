"""The alarms on the page: by priority, with the time since and who acknowledged; nothing moves under a hand."""

import itertools

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from tests.support.browser.fake_service import SESSION_ID, FakeService, alarm, person, sample
from tests.support.browser.tab import Tab
from tests.support.waiting import eventually

pytestmark = pytest.mark.browser

HOLD = sample(gate="hold")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
BEAM = alarm(1, "beam_without_permit", "high", "The accelerator reports beam on without a permit", latches=True)
LOST = alarm(2, "source_lost", "medium", "The camera is disconnected", latches=True, age_s=75.0)
SHIFTED = alarm(3, "patient_shifted", "medium", "The patient has moved on the couch", age_s=12.0, detail="7 mm")
PERMIT = alarm(4, "permit_without_beam", "low", "The beam is permitted, and the accelerator delivers none")


def shown(page: Page) -> list[str]:
    return page.locator("#alarms li").evaluate_all("items => items.map(item => item.dataset.code)")


def acknowledged(fake: FakeService) -> list[object]:
    return [body for path, body in fake.posts() if path == f"/sessions/{SESSION_ID}/acknowledge"]


def click_until_sent(fake: FakeService, page: Page) -> None:
    """Click until the click counts: the alarms have to be shown for a moment first."""
    button = page.locator("#alarms button")
    expect(button).to_be_enabled()

    def is_sent() -> bool:
        button.click()
        return acknowledged(fake) != []

    eventually(is_sent)


def test_nothing_is_shown_while_there_is_no_alarm(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", HOLD
    page = tab.open("hold")
    expect(page.locator("#alarms")).to_be_hidden()


def test_alarms_stand_in_the_order_of_the_controller_with_mark_time_and_person(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", HOLD
    seen = SHIFTED | {"acknowledged_by": "B. Physicist", "acknowledged_at": SHIFTED["since"]}
    fake.alarms = (BEAM, seen, PERMIT)
    page = tab.open("hold")
    expect(page.locator("#alarms li")).to_have_count(3)
    assert shown(page) == ["beam_without_permit", "patient_shifted", "permit_without_beam"]
    assert page.locator("#alarms li b").all_inner_texts() == ["!!!", "!!", "!"]
    expect(page.locator("#alarms li").nth(1).locator("> span")).to_have_text("7 mm · seen by B. Physicist")
    minutes, seconds = page.locator("#alarms li").nth(1).locator("time").inner_text().split(":")
    assert int(minutes) * 60 + int(seconds) >= 12
    fake.alarms = (PERMIT,)
    expect(page.locator("#alarms li")).to_have_count(1)
    fake.alarms = ()
    expect(page.locator("#alarms")).to_be_hidden()


def test_the_button_acknowledges_what_was_shown_and_leaves_the_gate_s_fault_to_its_own_button(
    fake: FakeService, tab: Tab
):
    fake.mode, fake.sample, fake.alarms = "samples", FAULT, (LOST, PERMIT)
    page = tab.open("fault")
    expect(page.locator("#alarms p")).to_have_text("Latched: acknowledge the fault.")
    button = page.locator("#alarms button")
    expect(button).to_be_enabled()
    click_until_sent(fake, page)
    expect(page.locator("#outcome")).to_have_text("Alarms acknowledged.")
    assert acknowledged(fake)[0] == {"operator": "A. Therapist", "alarms": [4]}
    fake.alarms = (LOST,)
    expect(button).to_be_hidden()


def test_an_alarm_that_has_just_appeared_is_not_acknowledged_by_a_click(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.alarms = "samples", HOLD, (SHIFTED,)
    page = tab.open("hold")
    click_until_sent(fake, page)
    sent = len(acknowledged(fake))
    # In one task: the alarm is drawn, and the click comes at once.
    fake.alarms = (SHIFTED, PERMIT)
    page.evaluate(
        """() => new Promise((resolve) => {
          const look = () => {
            if (document.querySelectorAll("#alarms li").length < 2) return setTimeout(look, 0);
            document.querySelector("#alarms button").click();
            resolve();
          };
          look();
        })"""
    )
    eventually(lambda: len(acknowledged(fake)) > sent)
    assert acknowledged(fake)[-1] == {"operator": "A. Therapist", "alarms": [3]}


def test_a_beam_without_a_permit_is_stated_at_the_gate_too_where_another_fault_is_latched(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.alarms = "samples", FAULT, (BEAM, LOST)
    page = tab.open("fault")
    expect(page.locator("#gate-warning")).to_have_text(
        "The accelerator reports beam on without a permit. Use the room's interlock."
    )
    fake.alarms = (LOST,)
    expect(page.locator("#gate-warning")).to_be_empty()


def test_an_alarm_moves_no_button(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", HOLD
    page = tab.open("hold")
    buttons = ("hold", "disarm", "arm", "release", "stop")
    before = [page.locator(f"#do-{name}").bounding_box() for name in buttons]
    fake.alarms = (BEAM, LOST, SHIFTED, PERMIT)
    expect(page.locator("#alarms li")).to_have_count(4)
    assert [page.locator(f"#do-{name}").bounding_box() for name in buttons] == before


def test_a_warning_stands_clear_of_the_gates_word_and_replaces_its_advice(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", HOLD
    page = tab.open("hold")
    expect(page.locator("#gate-do")).to_be_visible()
    fake.alarms = (BEAM,)
    expect(page.locator("#gate-warning")).to_be_visible()
    expect(page.locator(".gate .advice")).to_be_hidden()
    drawn = [
        page.locator(name).bounding_box() for name in (".gate .shape", "#gate-word", "#gate-reason", "#gate-warning")
    ]
    edges = [(box["y"], box["y"] + box["height"]) for box in drawn if box is not None]
    assert len(edges) == 4
    assert edges[0][1] - edges[0][0] >= 20, "the shape is too small"
    assert all(above[1] <= below[0] for above, below in itertools.pairwise(edges)), edges
    panel = page.locator("#gate").bounding_box()
    assert panel is not None
    assert panel["y"] <= edges[0][0]
    assert edges[-1][1] <= panel["y"] + panel["height"]


def test_a_viewer_sees_alarms_and_acknowledges_none(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.alarms = "samples", HOLD, (SHIFTED,)
    fake.person = person("V. Iewer", Role.VIEWER)
    page = tab.open("hold")
    expect(page.locator("#alarms li")).to_have_count(1)
    expect(page.locator("#alarms button")).to_be_disabled()


def test_alarms_of_a_lost_connection_are_not_shown_as_present(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.alarms = "samples", HOLD, (SHIFTED,)
    page = tab.open("hold")
    expect(page.locator("#alarms li")).to_have_count(1)
    fake.is_up = False
    expect(page.locator("#alarms")).to_be_hidden()
