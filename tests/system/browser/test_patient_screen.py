"""The patient's screen: what it draws in each state, and that nothing is drawn of what is old."""

import re

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.accessibility import SIZES, axe_findings, findings, focus_findings
from tests.support.browser.fake_coach import CODE, UNMEASURED, FakeCoach, SteppedScreen, guide

pytestmark = [pytest.mark.browser, pytest.mark.verification]
STALE_MS = 300


def shown(page: Page) -> str:
    """Every word of the guidance that a person could read or be read to."""
    return "".join(page.locator(place).text_content() or "" for place in ("#guide", "#say"))


def shows(screen: SteppedScreen, coach: FakeCoach, **changes: object) -> Page:
    """Open the page with this guidance, and wait until it is drawn."""
    coach.guide = guide(**changes)
    screen.page.goto(screen.tab.url)
    screen.advance_until(lambda: screen.kind == "guide")
    return screen.page


def test_silence_leaves_nothing_on_the_screen_within_300_ms_of_the_page_s_clock(coach, screen):
    page = shows(screen, coach, countdown_s=7.4, instruction="hold", level=0.7)
    expect(page.locator(".word")).to_have_text("Hold")
    coach.mode = "silent"
    screen.advance(STALE_MS - screen.step_ms)
    assert screen.kind == "guide"
    screen.advance(2 * screen.step_ms)
    assert (screen.kind, shown(page).strip()) == ("blank", "")
    assert page.locator(".guide-picture .guide").is_hidden()


def test_silence_while_waiting_leaves_nothing_either(coach, screen):
    coach.mode = "wait"
    screen.page.goto(screen.tab.url)
    screen.advance_until(lambda: screen.kind == "wait")
    coach.mode = "silent"
    screen.advance(STALE_MS + screen.step_ms)
    assert (screen.kind, shown(screen.page).strip()) == ("blank", "")


def test_an_old_frame_in_a_new_message_is_not_shown(coach, screen):
    page = shows(screen, coach)
    coach.guide = guide(age_ms=STALE_MS + 1.0)
    screen.advance_until(lambda: screen.kind == "blank", within_ms=STALE_MS + 100)
    assert shown(page).strip() == ""


def test_messages_that_queued_up_on_the_way_are_not_shown(coach, screen):
    shows(screen, coach)
    coach.lag_s = 2.0
    screen.advance_until(lambda: screen.kind == "blank", within_ms=200)


def test_a_lost_frame_changes_nothing_and_300_ms_of_them_leave_nothing(coach, screen):
    page = shows(screen, coach, level=0.7, instruction="hold")
    coach.guide = guide(**UNMEASURED)
    screen.advance(2 * screen.step_ms)
    expect(page.locator(".word")).to_have_text("Hold")
    screen.advance(STALE_MS)
    assert (screen.kind, shown(page).strip()) == ("blank", "")


def test_a_lost_connection_is_black_and_comes_back_by_itself(coach, screen):
    shows(screen, coach)
    coach.is_up = False
    screen.advance_until(lambda: screen.kind == "blank", within_ms=STALE_MS)
    coach.is_up = True
    screen.advance_until(lambda: screen.kind == "guide")
    assert coach.connections == 2


def test_another_version_of_the_stream_is_not_guessed_at(coach, patient_tab):
    coach.schema = "tidegate.coach/9"
    patient_tab.page.goto(patient_tab.url)
    patient_tab.await_that(lambda: patient_tab.page.evaluate("traffic.sequence") > 2)
    assert patient_tab.page.get_attribute("#guide", "data-show") == "blank"


@pytest.mark.parametrize(
    ("language", "words"),
    [
        ("en", ["Breathe in", "Hold", "Breathe out", "Breathe freely"]),
        ("de", ["Einatmen", "Anhalten", "Ausatmen", "Ruhig atmen"]),
    ],
)
def test_every_instruction_is_one_word_in_the_chosen_language(coach, screen, language, words):
    shows(screen, coach, language=language)
    for instruction, word in zip(("breathe_in", "hold", "breathe_out", "breathe_freely"), words, strict=True):
        coach.guide = guide(language=language, instruction=instruction)
        screen.advance_until(lambda word=word: screen.page.locator(".word").text_content() == word)
    assert screen.page.get_attribute("html", "lang") == language


def test_the_bar_stands_where_the_level_is_and_the_band_differs_in_shape(coach, screen):
    page = shows(screen, coach, level=0.7)
    inside, fill = page.get_attribute("#guide", "data-band"), page.locator(".fill").bounding_box()
    band = page.locator(".band").bounding_box()
    assert inside == "inside"
    assert band["y"] < fill["y"] < band["y"] + band["height"]
    coach.guide = guide(level=0.4)
    screen.advance_until(lambda: page.get_attribute("#guide", "data-band") == "outside")
    lower = page.locator(".fill").bounding_box()
    assert lower["y"] > band["y"] + band["height"]
    assert page.locator(".band").evaluate("one => getComputedStyle(one).strokeDasharray") != "none"


def test_the_curve_has_the_last_seconds_and_none_from_before_a_gap(coach, screen):
    coach.is_breathing = True
    page = shows(screen, coach, display="curve")
    screen.advance(1_500)
    points = page.locator(".line").get_attribute("points").split()
    assert len(points) > 20
    assert page.locator(".fill").is_hidden()
    coach.mode = "silent"
    screen.advance(1_000)
    assert page.locator(".line").get_attribute("points") == ""
    coach.mode = "guide"
    screen.advance_until(lambda: screen.kind == "guide")
    assert len(page.locator(".line").get_attribute("points").split()) < 5


def test_the_countdown_is_drawn_in_whole_seconds(coach, screen):
    page = shows(screen, coach, countdown_s=6.2, instruction="hold", level=0.7)
    expect(page.locator(".seconds")).to_have_text("7")
    coach.guide = guide(instruction="breathe_out", countdown_s=None)
    screen.advance_until(lambda: page.get_attribute("#guide", "data-counts") == "no")
    expect(page.locator(".seconds")).to_have_text("")


def test_practice_is_stated_on_the_screen(coach, screen):
    page = shows(screen, coach, is_practice=True)
    expect(page.locator(".practice")).to_have_text("Practice")


def test_a_screen_that_is_not_paired_asks_for_the_code_and_then_shows_the_guidance(coach, patient_tab):
    coach.is_paired, page = False, patient_tab.page
    page.goto(patient_tab.url)
    expect(page.locator("#pair-code")).to_be_focused()
    page.keyboard.type("111111")
    page.keyboard.press("Enter")
    expect(page.locator("#pair-outcome")).to_have_text("Not this code, or it has expired.")
    page.fill("#pair-code", f"{CODE[:3]} {CODE[3:]}")
    page.click("#pair button")
    expect(page.locator("#guide")).to_have_attribute("data-show", "guide")
    expect(page.locator("#pair")).to_be_hidden()
    assert [body for _, _, body in coach.calls] == [{"code": "111111"}, {"code": CODE}]


def test_an_address_that_has_to_wait_is_reported_how_long(coach, patient_tab):
    coach.is_paired, coach.wait_s = False, 64
    patient_tab.page.goto(patient_tab.url)
    patient_tab.page.fill("#pair-code", "123456")
    patient_tab.page.keyboard.press("Enter")
    expect(patient_tab.page.locator("#pair-outcome")).to_contain_text("64 s")


def test_an_ended_pairing_brings_the_form_back_without_a_trace_of_the_patient(coach, screen):
    page = shows(screen, coach, level=0.7, instruction="hold")
    coach.is_paired, coach.person = False, None
    screen.advance_until(lambda: page.locator("#pair").is_visible())
    assert page.get_attribute("#guide", "data-show") == "blank"
    assert "Hold" not in shown(page)


@pytest.mark.parametrize("key", ["bar", "curve"])
def test_who_wants_less_motion_gets_a_bar(coach, screen, key):
    screen.page.emulate_media(reduced_motion="reduce")
    page = shows(screen, coach, display=key)
    assert page.get_attribute("#guide", "data-display") == "bar"


def test_forced_colours_leave_band_and_bar_visible(coach, screen):
    screen.page.emulate_media(forced_colors="active")
    page = shows(screen, coach)
    ground, mark, band = (
        page.locator(one).evaluate(f"one => getComputedStyle(one).{style}")
        for one, style in ((".guide-picture", "backgroundColor"), (".mark >> nth=0", "fill"), (".band", "stroke"))
    )
    assert len({ground, mark, band}) == 3


def test_text_and_shapes_have_the_contrast_of_large_graphics(coach, screen):
    page = shows(screen, coach, level=0.7, countdown_s=5.0, instruction="hold", is_practice=True)
    for place, style, least in (
        (".word", "fill", 7.0),
        (".practice", "fill", 7.0),
        (".fill", "fill", 3.0),
        (".band", "stroke", 3.0),
        (".ring", "stroke", 7.0),
    ):
        color = page.locator(place).evaluate(f"one => getComputedStyle(one).{style}")
        assert contrast_on_black(color) >= least, place


def contrast_on_black(color: str) -> float:
    """The contrast ratio of WCAG 2 against black."""
    channels = [int(one) / 255 for one in re.findall(r"\d+", color)[:3]]
    linear = [one / 12.92 if one <= 0.04045 else ((one + 0.055) / 1.055) ** 2.4 for one in channels]
    return (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05) / 0.05


# Stands for the browser's sound: notes what would be played.
LISTEN = """(() => {
  window.tones = [];
  const ramp = { linearRampToValueAtTime() {}, setValueAtTime() {} };
  const node = { connect: (other) => other, frequency: ramp, gain: ramp };
  window.AudioContext = class { constructor() { this.state = "running"; this.currentTime = 0; } async resume() {} };
  window.GainNode = class { constructor() { Object.assign(this, node); } };
  window.OscillatorNode = class {
    constructor(context, { frequency }) { Object.assign(this, node, { pitch: frequency }); }
    start() { window.tones.push(this.pitch); }
    stop() {}
  };
})()"""


def test_a_new_instruction_sounds_once_if_sounds_are_on_and_the_screen_was_touched(coach, screen):
    page = screen.page
    page.add_init_script(LISTEN)
    shows(screen, coach, sounds=True, instruction="breathe_in")
    assert page.evaluate("tones") == [], "no browser plays before a touch"
    page.mouse.click(600, 400)
    for instruction in ("hold", "hold", "breathe_out", "breathe_freely"):
        coach.guide = guide(sounds=True, instruction=instruction)
        screen.advance(2 * screen.step_ms)
    assert page.evaluate("tones") == [392, 440]
    coach.guide = guide(sounds=False, instruction="breathe_in")
    screen.advance(2 * screen.step_ms)
    assert page.evaluate("tones") == [392, 440]


@pytest.mark.parametrize("changes", [{}, {"instruction": "hold", "countdown_s": 5.0}, {"is_practice": True}], ids=str)
def test_the_guidance_is_accessible(coach, patient_tab, changes):
    coach.guide, page = guide(**changes), patient_tab.page
    page.goto(patient_tab.url)
    expect(page.locator("#guide")).to_have_attribute("data-show", "guide")
    assert axe_findings(page) == []


@pytest.mark.parametrize("size", [*SIZES, (320, 640)], ids=str)
def test_the_form_for_the_code_is_accessible_and_fits(coach, patient_tab, size):
    coach.is_paired, page = False, patient_tab.page
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.goto(patient_tab.url)
    page.fill("#pair-code", "111111")
    page.keyboard.press("Enter")
    expect(page.locator("#pair-outcome")).not_to_be_empty()
    assert axe_findings(page) == []
    assert findings(page, "borders", 3.0) + findings(page, "outside") + findings(page, "clipped") == []
    count, hidden = focus_findings(page)
    assert (count >= 2, hidden) == (True, [])
