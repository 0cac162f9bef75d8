"""The window's form: every kind there is, only the fields that matter, and what it sends is what the service takes."""

import pytest
from playwright.sync_api import Page, expect
from pydantic import ValidationError

from service.core.schemas.windows import Window
from tests.support.browser.fake_service import FakeService
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


@pytest.fixture
def form(fake: FakeService, tab: Tab) -> Page:
    fake.sessions = []
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    page.fill("[name=patient_reference]", "P-0200")
    page.fill("[name=plan_id]", "PLAN-9")
    page.fill("[name=fraction_id]", "FX-1")
    page.select_option("[name=source]", "recording:demo/recording.oni")
    page.click("#more-settings summary")
    page.select_option("[data-edges]", "length")
    return page


def sent(fake: FakeService, page: Page) -> dict:
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup")).to_be_hidden()
    (body,) = [body for path, body in fake.posts() if path == "/sessions"]
    Window.model_validate(body["window"])
    return body


def choose(page: Page, name: str, value: str, path: str = "window") -> None:
    page.select_option(f"[name='{path}.{name}']", value)


def hold_between(page: Page, path: str) -> None:
    """Type the edges of a breath hold, in the unit that is shown: none are suggested."""
    for edge, value in (("lower", "8"), ("upper", "14")):
        field = page.locator(f"[name^='{path}.{edge}_']:visible")
        expect(field).to_have_value("")
        field.fill(value)


def fields(page: Page, place: int = 0) -> set[str]:
    """Names of the fields of a condition that can be seen."""
    inputs = page.locator(".condition").nth(place).locator("[data-name]:visible")
    return set(inputs.evaluate_all("all => all.map(one => one.dataset.name)"))


@pytest.mark.parametrize(
    ("chosen", "shown"),
    [
        ({}, {"lower_mm", "upper_mm", "hysteresis_mm"}),
        ({"signal": "volume"}, {"lower_l", "upper_l", "hysteresis_l"}),
        ({"signal": "point"}, {"row", "column", "lower_mm", "upper_mm", "hysteresis_mm"}),
        ({"signal": "named"}, {"name", "lower_mm", "upper_mm", "hysteresis_mm"}),
        (
            {"kind": "breath_hold"},
            {"lower_mm", "upper_mm", "hold", "settle_ms", "still_mm", "max_drift_mm", "timeout_s"},
        ),
        (
            {"kind": "breath_hold", "signal": "volume"},
            {"lower_l", "upper_l", "hold", "settle_ms", "still_l", "max_drift_l", "timeout_s"},
        ),
        ({"kind": "phase"}, {"from_percent", "to_percent", "min_confidence"}),
    ],
    ids=lambda told: " ".join(sorted(map(str, told))) or "nothing told",
)
def test_only_the_fields_of_the_kind_and_signal_are_asked_and_the_service_takes_them(
    fake: FakeService, form: Page, chosen: dict[str, str], shown: set[str]
):
    for name, value in chosen.items():
        choose(form, name, value)
    assert fields(form) == {"kind", "signal"} | shown
    if chosen.get("kind") == "breath_hold":
        hold_between(form, "window")
        shown = shown | {"hysteresis_l" if "lower_l" in shown else "hysteresis_mm"}
        assert fields(form) == {"kind", "signal"} | shown
    if "name" in shown:
        form.fill("[name='window.name']", "belly")
    window = sent(fake, form)["window"]
    assert set(window) == {"kind", "signal", "dwell_ms"} | shown


@pytest.mark.parametrize("signal", ["whole", "volume"])
def test_edges_can_be_reported_in_per_cent_of_the_learned_range(fake: FakeService, form: Page, signal: str):
    choose(form, "signal", signal)
    form.locator("[data-edges]").select_option("percent")
    assert {"lower_percent", "upper_percent", "hysteresis_percent"} <= fields(form)
    window = sent(fake, form)["window"]
    assert (window["lower_percent"], window["upper_percent"]) == (-10, 30)
    assert not {name for name in window if name.endswith(("_mm", "_l"))}


def test_a_breath_hold_is_created_without_edges_before_a_breath_was_held(fake: FakeService, form: Page):
    choose(form, "kind", "breath_hold")
    window = sent(fake, form)["window"]
    assert not {name for name in window if name.startswith(("lower", "upper", "hysteresis"))}


def test_a_breath_hold_is_created_with_both_edges_and_no_others(fake: FakeService, form: Page):
    """Review N1: the end of exhale's edges were offered, and the beam was on in the pauses of free breathing."""
    lower = form.locator("[name='window.lower_mm']")
    choose(form, "kind", "breath_hold")
    expect(lower).to_have_value("")
    choose(form, "kind", "amplitude")
    expect(lower).to_have_value("-1")
    lower.fill("7.5")
    choose(form, "kind", "breath_hold")
    expect(lower).to_have_value("7.5")
    expect(form.locator("[name='window.upper_mm']")).to_have_value("")
    with pytest.raises(ValidationError, match="upper_mm"):  # as the controller does
        sent(fake, form)


def test_up_to_four_conditions_are_joined_and_can_be_removed(fake: FakeService, form: Page):
    expect(form.locator("#join-field")).to_be_hidden()
    for _ in range(3):
        form.click("#add-condition")
    expect(form.locator("#add-condition")).to_be_disabled()
    choose(form, "kind", "phase", "window.further.0")
    choose(form, "kind", "breath_hold", "window.further.2")
    form.locator(".condition").nth(2).locator(".remove").click()
    expect(form.locator("#add-condition")).to_be_enabled()
    choose(form, "join", "or")
    hold_between(form, "window.further.1")
    window = sent(fake, form)["window"]
    assert [one["kind"] for one in window["further"]] == ["phase", "breath_hold"]
    assert window["join"] == "or"
    assert set(window["further"][0]) == {"kind", "signal", "from_percent", "to_percent", "min_confidence"}


def test_how_often_the_beam_may_switch_is_left_to_the_site_unless_reported(fake: FakeService, form: Page):
    form.fill("[name='window.max_cycles_per_min']", "20")
    window = sent(fake, form)["window"]
    assert window["max_cycles_per_min"] == 20
    assert "min_on_ms" not in window
    assert "min_off_ms" not in window


def test_own_regions_are_asked_for_where_one_is_gated_on(fake: FakeService, form: Page):
    expect(form.locator("#own-regions")).to_be_hidden()
    choose(form, "signal", "named")
    form.fill("[name='regions.named']", "belly=220,40;220,160;320,100 chest=20,40;20,160;120,100")
    form.fill("[name='window.name']", "belly")
    body = sent(fake, form)
    assert body["regions"] == {
        "named": [
            {"name": "belly", "vertices": [[220, 40], [220, 160], [320, 100]]},
            {"name": "chest", "vertices": [[20, 40], [20, 160], [120, 100]]},
        ]
    }


def test_a_refusal_points_into_the_condition_it_is_about(fake: FakeService, form: Page):
    form.click("#add-condition")
    fake.problem = (
        422,
        {"code": "invalid_value", "detail": "no", "field": "window.further.0.upper_percent", "bound": "less"},
    )
    form.click("#new-session [type=submit]")
    wrong = form.locator("[aria-invalid=true]")
    expect(wrong).to_have_count(1)
    expect(wrong).to_have_attribute("name", "window.further.0.upper_percent")
    expect(wrong).to_be_focused()
