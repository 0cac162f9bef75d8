"""Training beside the measuring: a waiting model is applied by name; refusals and a missing reference are reported."""

from typing import Any

import pytest
from playwright.sync_api import expect

from engine.core.frames import TrainingProgress
from service.core.schemas import sessions
from tests.support.browser.fake_service import SESSION, SESSION_ID, WAITING, FakeService, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab
from tests.support.motion.training_frames import Patient

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NONE = "\N{EN DASH}"
DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed")
GATHERING = {"frames": 88, "cycles": 1, "seconds": 2.9, "share": 0.4, "note": ""}
FITTING = WAITING | {"note": "fitting the model"}
LIKENESS = {
    "is_accepted": True,
    "refusal": None,
    "frames": 150,
    "explained_share": 0.99,
    "residual_mm": 0.6,
    "shift_mm": [2.0, -1.0, 2.0],
    "tilt_deg": 0.44,
    "shape_mm": 0.81,
}
SUMMARY = {"frames": 513, "missed_frames": 0, "lost": 0, "duty_cycle": None, "transitions": 0} | {
    "latency": {"p50_ms": 5.0, "p99_ms": 9.1}
}


def detail(**changes: Any) -> dict[str, Any]:
    """Return the running session as it answers when it is read, held against the contract."""
    answer = SESSION | {
        "gate": None,
        "measurement_state": "measuring",
        "training": None,
        "active_model_id": None,
        "has_reference": True,
        "likeness": None,
        "summary": SUMMARY,
    }
    sessions.SessionDetail.model_validate(answer | changes)
    return answer | changes


def learning_message(progress: TrainingProgress | None) -> dict[str, Any]:
    """Return what the learner says as the stream carries it."""
    assert progress is not None
    return {name: getattr(progress, name) for name in ("frames", "cycles", "seconds", "share", "note")}


def calls_to(fake: FakeService, path: str) -> list[object]:
    return [body for called, body in fake.posts() if called == f"/sessions/{SESSION_ID}/{path}"]


def waiting_patient() -> Patient:
    """A patient whose second model is ready while the gate is armed with the first."""
    patient = Patient()
    patient.learn()
    patient.learner.keep_model(is_kept=True)
    patient.learner.retrain()
    patient.see_until(lambda: patient.learner.status.is_model_waiting)
    return patient


def test_a_model_that_waits_is_stated_and_applied_by_name(fake: FakeService, tab: Tab):
    """The engine's own words for it, so that neither side changes them alone."""
    waiting = learning_message(waiting_patient().learner.models.progress)
    assert waiting == WAITING
    fake.mode, fake.sample = "samples", sample(gate="hold")
    page = tab.open("hold")
    apply = page.locator("#do-apply")
    expect(apply).to_be_hidden()
    fake.sample = sample(gate="hold", training=waiting)
    expect(page.locator("#learning-title")).to_have_text("A new model is ready")
    expect(page.locator("#learning-detail")).to_contain_text("Applying it disarms.")
    expect(page.locator("#learning-bar")).to_be_hidden()
    apply.click()
    expect(page.locator("#outcome")).to_have_text("Disarmed. The new model is applied.")
    assert calls_to(fake, "models/apply") == [{"operator": "A. Therapist"}]


LONG_REFUSAL = WAITING | {"share": 0.0, "note": "the patient has moved, and all of this is to be read; " * 6}


@pytest.mark.parametrize("training", [WAITING, LONG_REFUSAL], ids=["waiting", "refused"])
def test_what_the_learning_has_to_say_moves_no_button(fake: FakeService, tab: Tab, training: dict):
    """A hand on its way to one button must not land on another: a model takes over, and Apply goes, at any moment."""
    fake.mode, fake.sample = "samples", sample(gate="hold")
    page = tab.open("hold")
    buttons = [
        page.locator(f"#do-{name}") for name in ("disarm", "arm", "reference", "retrain", "start", "stop", "setup")
    ]
    tab.draws(fake)
    before = [button.bounding_box() for button in buttons]
    fake.sample = sample(gate="hold", training=training)
    expect(page.locator("#learning")).to_have_attribute("data-stage", "waiting" if training is WAITING else "refused")
    tab.draws(fake)
    assert page.locator("#do-apply").is_visible() == (training is WAITING)
    assert [button.bounding_box() for button in buttons] == before
    spills = "e => e.scrollHeight > e.clientHeight && getComputedStyle(e).overflowY === 'visible'"
    assert not page.locator("#learning").evaluate(spills), "the text lies over the buttons"


def test_apply_keeps_its_place_and_does_nothing_when_the_stream_is_silent(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(sample(gate="hold", training=WAITING))
    expect(page.locator("#do-apply")).to_be_enabled()
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    stepped.advance(200)
    expect(page.locator("#do-apply")).to_be_disabled()
    expect(page.locator("#keep-reference")).to_be_disabled()


def test_a_refused_apply_shows_why(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="hold", training=WAITING)
    fake.problem = (409, {"code": "command_refused", "detail": "no new model waits to be applied"})
    page = tab.open("hold")
    page.click("#do-apply")
    expect(page.locator("#outcome")).to_have_text("Apply: no new model waits to be applied")


def test_learning_again_keeps_the_reference_unless_reported_otherwise_and_only_once(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    for keeps in (True, False):
        page.set_checked("#keep-reference", keeps)
        page.click("#do-retrain")
        expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
        expect(page.locator("#keep-reference")).to_be_checked()
        fake_calls = calls_to(fake, "models/retrain")
        assert fake_calls[-1] == {"operator": "A. Therapist", "keeps_reference": keeps}
    assert len(fake_calls) == 2


@pytest.mark.parametrize(("training", "text"), [(GATHERING, "88 frames · 1 breath · 3 s"), (FITTING, FITTING["note"])])
def test_learning_while_measuring_shows_its_progress(fake: FakeService, tab: Tab, training: dict, text: str):
    fake.mode, fake.sample = "samples", sample(gate="hold", training=training)
    page = tab.open("hold")
    expect(page.locator("#learning-title")).to_have_text("Measuring, training again")
    expect(page.locator("#learning-detail")).to_have_text(text)
    expect(page.locator("#do-retrain")).to_have_attribute("title", "Not now: already training")


def test_a_refused_model_is_read_while_the_present_one_measures_on(fake: FakeService, tab: Tab):
    note = "carry.correction_mm: 4.2 mm is more than 3 mm: the patient has moved"
    fake.mode, fake.sample = "samples", sample(gate="hold", training=WAITING | {"share": 0.0, "note": note})
    page = tab.open("hold")
    expect(page.locator("#learning-title")).to_have_text("Measuring, no new model")
    expect(page.locator("#learning-detail")).to_have_text(f"Refused: {note}")
    expect(page.locator("#learning-bar")).to_be_hidden()
    expect(page.locator("#do-retrain")).to_be_enabled()


def test_a_session_without_a_reference_asks_for_the_reference(fake: FakeService, tab: Tab):
    fake.sessions = [detail(has_reference=False)]
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    expect(page.locator("#gate-reason")).to_have_text("Not armed. Set the reference before arming.")
    expect(page.locator("#learning-detail")).to_contain_text("set the reference")
    expect(page.locator("#hint")).to_have_text("To arm: set the reference first.")
    expect(page.locator("#do-arm")).to_be_disabled()
    fake.sessions = [detail()]
    page.click("#do-reference")
    expect(page.locator("#do-arm")).to_be_enabled()
    expect(page.locator("#gate-reason")).to_have_text("Not armed")


def test_what_is_proposed_is_shown_before_it_is_confirmed(fake: FakeService, tab: Tab):
    fake.sessions = [detail(has_reference=False, reference_proposals=[])]
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    expect(page.locator("#do-reference")).to_be_disabled()
    expect(page.locator("#reference-proposal")).to_contain_text("Two breaths have to be seen")
    fake.sessions = [detail(has_reference=False)]
    expect(page.locator("#reference-proposal")).to_have_text(
        "Mean of 4 breaths: \N{MINUS SIGN}1.25 mm, scatter 0.21 mm, at 2 % of the learned breath."
    )
    page.select_option("#reference-at", "end_inhale")
    expect(page.locator("#do-reference")).to_be_disabled()
    page.select_option("#reference-at", "now")
    page.fill("#reference-reason", "  breath hold  ")
    page.click("#do-reference")
    expect(page.locator("#reference-reason")).to_have_value("")
    assert calls_to(fake, "reference") == [{"operator": "A. Therapist", "at": "now", "reason": "breath hold"}]


def test_a_first_reference_that_sets_itself_is_not_asked_for(fake: FakeService, tab: Tab):
    """Read while it still learned, and not yet again."""
    fake.sessions = [detail(has_reference=False, measurement_state="training")]
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    expect(page.locator("#who-patient")).to_have_text("P-0117")
    expect(page.locator("#do-arm")).to_be_enabled()


def test_no_one_is_offered_to_arm_while_the_stored_model_is_compared(fake: FakeService, tab: Tab):
    patient = Patient()
    model = patient.learn()
    today = Patient()
    today.learner.models.resume(model)
    today.see()
    fake.mode, fake.sample = "samples", DISARMED | {"training": learning_message(today.learner.models.progress)}
    page = tab.open("disarmed")
    expect(page.locator("#learning-title")).to_have_text("Measuring, comparing")
    for action in ("arm", "retrain"):
        expect(page.locator(f"#do-{action}")).to_be_disabled()


def test_likeness_to_the_stored_model_is_shown_and_is_a_dash_when_stale(fake: FakeService, stepped: SteppedPage):
    fake.sessions = [detail(likeness=LIKENESS)]
    page = stepped.open(DISARMED)
    stepped.advance(400)
    figure = page.locator("#figure-likeness")
    expect(figure).to_have_text("3.0 mm · 0.4° · 0.8 mm")
    fake.sessions = [detail(likeness=LIKENESS | {"is_accepted": False, "refusal": "model.shift_mm: 31 mm"})]
    stepped.advance(2_400)
    expect(page.locator("#likeness-name")).to_contain_text("Refused model")
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    stepped.advance(200)
    expect(figure).to_have_text(NONE)


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1024, 768)])
def test_a_waiting_model_leaves_everything_on_the_screen(fake: FakeService, tab: Tab, width: int, height: int):
    tab.page.set_viewport_size({"width": width, "height": height})
    fake.sessions = [detail(likeness=LIKENESS)]
    fake.mode, fake.sample = "samples", sample(gate="hold", training=WAITING)
    page = tab.open("hold")
    expect(page.locator("#do-apply")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollHeight") == height
    for name in ("#do-apply", "#outcome", "#gate-reason"):
        box = page.locator(name).bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= height, f"{name} is cut off"
