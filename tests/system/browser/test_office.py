"""The office: sessions, plans, models, QA, audit and machine, each for those who may see it."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, Page, expect

from service.core.permissions import Role
from tests.support.browser.accessibility import axe_findings
from tests.support.browser.fake_service import DASHBOARD, PLAN, RECORDING, FakeService, api_key, over, person, user
from tests.support.browser.tab import Tab
from tests.support.planning.dicom_plans import motion, photon_plan, setup, written
from tests.support.repository import ROOT
from tests.support.service.accounts import PASSWORD, provision
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

pytestmark = [pytest.mark.browser, pytest.mark.verification]

REVIEW = f"session/{over()['id']}"
ROOMS = ("sessions", REVIEW, "plans", "models", "qa", "audit", "people", "machine", "api")
CONTRACT = json.loads((ROOT / "openapi" / "openapi.json").read_text())
GERMAN = json.loads((DASHBOARD / "lang" / "de.json").read_text())
PHYSICIST = person("P. Hysicist", Role.PHYSICIST)


def run(at: str, value: float, verdict: str) -> dict[str, object]:
    judged = {"expected": 850.0, "deviation": value - 850.0, "warn": 1.0, "fail": 2.0, "verdict": verdict}
    return {"run_id": "11" * 16, "kind": "daily", "at": f"{at}T07:00:00Z", "value": value, **judged}


TREND = {
    "check": "camera_distance_mm",
    "title": "Camera distance",
    "unit": "mm",
    "sidedness": "absolute",
    "items": [run("2026-11-24", 852.4, "fail"), run("2026-11-23", 851.2, "warn"), run("2026-11-22", 850.1, "pass")],
}
NEVER: dict[str, object] = {"items": [], "next_cursor": None}
READY = {"is_ready": True, "not_ready": [], "reasons": [], "warnings": [], "checked_at": "2026-11-24T07:00:00Z"}
SETTINGS = [
    {"name": "TIDEGATE_PORT", "section": "server", "value": "9000", "source": "environment"},
    {"name": "TIDEGATE_ROOM", "section": "server", "value": '"***"', "source": "default"},
]
MACHINE = {
    "version": "0.2.0",
    "method": 12,
    "python": "3.11.7",
    "system": "Linux",
    "backup_at": "2026-11-23T22:00:00Z",
    "certificate_ends_at": None,
    "started_at": "2026-11-24T01:00:00Z",
    "now": "2026-11-24T07:30:00Z",
    "disk_free_mb": 2048,
    "disk_total_mb": 4096,
    "plug_ins": ["acme-cameras 1.2: acme=0f0f"],
    "readiness": READY,
    "settings": SETTINGS,
}


@pytest.fixture
def office(fake: FakeService, own_tab: Tab) -> Tab:
    fake.person, fake.sessions, fake.plans = PHYSICIST, [over()], [PLAN]
    fake.office = {
        "/qa/runs": NEVER,
        "/qa/checks": {"items": [{"code": "camera_distance_mm", "title": "Camera distance"}]},
        "/qa/trend": TREND,
        "/qa/latency": {"items": []},
        "/qa/baseline": {"number": 0, "earlier": []},
        "/machine": MACHINE,
        "/openapi.json": CONTRACT,
    }
    own_tab.url += "/office/"
    return own_tab


def opened(tab: Tab, room: str) -> Page:
    tab.page.goto(f"{tab.url}#{room}")
    expect(tab.page.locator("#rooms [aria-current]")).to_have_attribute(
        "href", "#sessions" if room == REVIEW else f"#{room}"
    )
    tab.is_answered()
    return tab.page


def permitted(fake: FakeService, tab: Tab, room: str) -> Page:
    """A room, opened by a person who may see it."""
    if room == "people":
        fake.person = person("Grace", Role.ADMIN)
        fake.people = [user("Grace", Role.ADMIN), user("A. Therapist", Role.THERAPIST, is_disabled=True)]
        fake.keys = [api_key("planning", "sessions.read", "sessions.run")]
    return opened(tab, room)


def test_without_a_log_in_it_shows_nothing_and_the_way_to_one(fake: FakeService, office: Tab):
    fake.person = None
    office.page.goto(office.url)
    expect(office.page.locator("#room > a")).to_have_text("Log in")
    assert {path for _, path, _ in fake.calls} == {"/api/v1/me"}


def test_a_log_in_that_ends_leaves_nothing_of_a_patient_on_the_page(fake: FakeService, office: Tab):
    page = opened(office, "sessions")
    expect(page.locator("tbody tr")).to_contain_text("P-0117")
    fake.person = None
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#room > a")).to_have_text("Log in")
    assert "P-0117" not in page.inner_text("body")


def test_each_role_sees_its_rooms(fake: FakeService, office: Tab):
    fake.person = person("V. Iewer", Role.VIEWER)
    page = opened(office, "sessions")
    expect(page.locator("#rooms a")).to_have_text(["Sessions", "Plans", "Motion models", "QA", "API"])
    page.goto(f"{office.url}#machine")
    expect(page.locator("#rooms [aria-current]")).to_have_text("Sessions")
    opened(office, "plans")
    expect(page.locator("input[type=file]")).to_have_count(0)
    opened(office, "qa")
    expect(page.get_by_role("button", name="Start QA")).to_have_count(0)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_accessible_in_both_themes_and_fits(fake: FakeService, office: Tab, room: str):
    page = permitted(fake, office, room)
    for theme in ("dark", "bright"):
        page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
        assert axe_findings(page) == [], theme
    for width in (1280, 768):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_in_german_has_no_word_of_english(fake: FakeService, office: Tab, room: str):
    office.page.add_init_script("localStorage.setItem('tidegate.language', 'de')")
    page = permitted(fake, office, room)
    expect(page.locator("h1")).to_contain_text("P-0117" if room == REVIEW else GERMAN[f"office.{room}"])
    assert "[en]" not in page.inner_text("body")


def test_sessions_lead_to_their_review_and_their_figures_stand_side_by_side(fake: FakeService, office: Tab):
    fake.sessions = [over(), over(patient_reference="P-0002") | {"id": "66" * 16}]
    page = opened(office, "sessions")
    expect(page.locator("tbody tr")).to_have_count(2)
    expect(page.locator("tbody a").first).to_have_attribute("href", f"#{REVIEW}")
    page.get_by_role("button", name="Patient").click()
    expect(page.locator("tbody tr").first).to_contain_text("P-0002")
    page.get_by_role("button", name="Show figures").click()
    figures = fake.report["figures"]
    for row in range(2):
        expect(page.locator("tbody tr").nth(row)).to_contain_text(f"{figures['beam_on_s']:.1f} s")
        expect(page.locator("tbody tr").nth(row)).to_contain_text(f"{figures['duty_percent']:.0f} %")
    page.get_by_role("searchbox").fill("P-0002")
    page.get_by_label("State").select_option("stopped")
    page.get_by_label("From").fill("2026-11-01")
    with page.expect_request("**/sessions?*") as asked:
        page.keyboard.press("Enter")
    assert {"search=P-0002", "status=stopped", "since=2026-11-01T00%3A00%3A00.000Z"} <= {
        *asked.value.url.partition("?")[2].split("&")
    }
    expect(page.locator("tbody tr")).to_have_count(1)


def test_a_person_logs_out_here_and_comes_back_to_the_same_room_after_a_log_in(fake: FakeService, office: Tab):
    page = opened(office, "plans")
    page.get_by_role("button", name="Log out").click()
    page.get_by_role("button", name="hold").click()  # asked first: a gate may be armed at the console
    page.locator("#room > a").click()
    fake.passwords["A. Physicist"] = (PASSWORD, PHYSICIST)
    page.fill("[name=name]", "A. Physicist")
    page.fill("[name=password]", PASSWORD)
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("Plans")


def test_the_appearance_is_that_of_the_system_until_one_is_chosen(office: Tab):
    page = opened(office, "plans")
    root = page.locator("html")
    expect(root).to_have_attribute("data-theme", "dark")
    page.emulate_media(color_scheme="light")
    expect(root).to_have_attribute("data-theme", "bright")
    page.locator("#theme").select_option("dark")
    expect(root).to_have_attribute("data-theme", "dark")


def test_a_check_is_drawn_with_its_limits_and_readable_as_numbers(office: Tab):
    page = opened(office, "qa")
    expect(page.locator("svg circle")).to_have_count(3)
    heights = page.eval_on_selector_all("svg circle", "all => all.map((one) => Number(one.getAttribute('cy')))")
    assert heights == sorted(heights, reverse=True), "oldest first, and a larger value lies higher"
    upper_fail = page.locator("svg polyline").nth(3).get_attribute("points").split()[0].split(",")[1]
    assert heights[2] < float(upper_fail) < heights[1], "2 mm lie between the failed and the warned run"
    page.get_by_text("As a table").click()
    expect(page.locator("details tbody tr").first).to_contain_text("852.400 mm")
    expect(page.locator("details tbody tr").first).to_contain_text("failed")


def test_settings_of_the_site_come_first_and_secrets_stay_masked(office: Tab):
    page = opened(office, "machine")
    expect(page.locator("dl")).to_contain_text("Plug-inacme-cameras 1.2: acme=0f0f")
    expect(page.locator("section > .wide tbody tr")).to_have_count(1)
    expect(page.locator("section > .wide tbody tr")).to_contain_text("TIDEGATE_PORT")
    expect(page.locator("dl")).to_contain_text("2.0 of 4.0 GB free")
    expect(page.locator("details summary")).to_have_text("1 settings at their default")


def test_every_call_of_the_contract_is_there_and_opens_with_its_fields(office: Tab):
    page = opened(office, "api")
    calls = [f"{method.upper()} {path}" for path, one in CONTRACT["paths"].items() for method in one]
    assert sorted(page.locator("#room summary").all_inner_texts()) == sorted(calls)
    page.get_by_text("POST /api/v1/sessions/{session_id}/hold", exact=True).click()
    opened_call = page.locator("#room details[open]")
    expect(opened_call).to_contain_text("Needs the permission gate.hold.")
    expect(opened_call).to_contain_text("session_id")
    page.get_by_text("POST /api/v1/sessions", exact=True).click()
    expect(opened_call.first).to_contain_text("patient_reference")
    expect(opened_call.first.locator("h3")).to_contain_text(["Body, application/json", "Answer 201", "Refusals"])


def test_the_contract_is_read_without_a_log_in(fake: FakeService, office: Tab):
    fake.person = None
    office.page.goto(f"{office.url}#api")
    expect(office.page.locator("#rooms a")).to_have_text("API")
    expect(office.page.get_by_text("POST /api/v1/sessions", exact=True)).to_be_visible()
    expect(office.page.get_by_text("Log in")).to_be_visible()
    office.page.goto(f"{office.url}#machine")
    expect(office.page.locator("#room")).to_have_text("Log in")
    assert {path for _, path, _ in fake.calls} == {"/api/v1/me", "/api/v1/openapi.json"}


def test_a_model_is_compared_with_the_patients_model_before_it(fake: FakeService, office: Tab):
    made = {"patient_reference": "P-0117", "is_active": False, "created_at": "2026-11-24T07:00:00Z", "quality": None}
    made |= {"training_frames": 400, "components": 3}
    later, earlier = made | {"id": "ba" * 16, "number": 2}, made | {"id": "ab" * 16, "number": 1}
    fake.models = [later, earlier]
    alike = {"explained_share": 0.987, "first_angle_deg": 4.2, "shift_mm": 1.0, "shape_mm": 2.46}
    fake.office[f"/models/{later['id']}/similarity"] = alike
    page = opened(office, "models")
    rows = page.locator("tbody tr")
    expect(rows.nth(1)).to_contain_text("first one")
    rows.nth(0).get_by_role("button").nth(1).click()
    expect(rows.nth(0)).to_contain_text("98.7 % of its motion · 4.2° · shape 2.5 mm")


def test_monthly_qa_asks_for_phantom_and_trace_and_daily_does_not(fake: FakeService, office: Tab):
    fake.recordings = [RECORDING]
    page = opened(office, "qa")
    trace = page.get_by_label("Its trace, a file in a recording folder")
    expect(trace).to_be_hidden()
    page.get_by_label("Kind").select_option("monthly")
    trace.fill("qa/sine.csv")
    page.get_by_label("Phantom seen by").select_option(RECORDING["path"])
    page.get_by_label("Window from, mm of the trace").fill("-20")
    page.get_by_label("Window to, mm").fill("2.5")
    page.get_by_role("button", name="Start QA").click()
    eventually(lambda: fake.posts() != [], detail=lambda: fake.calls)
    ((path, body),) = fake.posts()
    assert (path, body["kind"]) == ("/qa/runs", "monthly")
    source = {"kind": "recording", "path": RECORDING["path"]}
    window = {"window_lower_mm": -20, "window_upper_mm": 2.5}
    assert body["phantom"] == {"source": source, "trace": "qa/sine.csv", **window}
    assert body["plate"] == {"source": {"kind": "device"}}


def test_an_answer_that_does_not_come_is_said(fake: FakeService, office: Tab):
    del fake.office["/machine"]
    expect(opened(office, "machine").locator("#room")).to_contain_text("no such session")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    root, port = tmp_path_factory.mktemp("office"), free_port()
    provision(root / "data", people={"P. Hysicist": [Role.PHYSICIST]}, password=PASSWORD)
    gated = photon_plan(RTPlanLabel="LUNG_GATED", PatientSetupSequence=[setup(1, motion("GATING"))])
    (root / "plan.dcm").write_bytes(written(gated))
    (root / "none.dcm").write_bytes(b"no plan")
    place = {"port": port, "log": root / "log", "data": root / "data"}
    serve = ("serve", "--port", str(port), "--data", str(root / "data"))
    with service_process("service.cli", *serve, **place) as (_, http):
        request = {"kind": "daily", "operator": "A. Physicist", "simulation": {"seed": 3, "faults": {}}}
        started = http.post("/api/v1/qa/runs", json=request).json()["id"]
        eventually(lambda: http.get(f"/api/v1/qa/runs/{started}").json()["status"] != "running", within_s=60.0)
        yield f"http://127.0.0.1:{port}", root


def test_the_rooms_of_a_real_service(served: tuple[str, Path], context: BrowserContext):
    url, root = served
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    page.locator("#log-in [name=name]").fill("P. Hysicist")
    page.locator("#log-in [name=password]").fill(PASSWORD)
    page.keyboard.press("Enter")
    expect(page.locator("#person-name")).to_have_text("P. Hysicist")
    with page.expect_popup() as popup:
        page.get_by_role("link", name="Office").click()
    page = popup.value
    page.on("pageerror", lambda error: errors.append(str(error)))
    expect(page.locator("#room")).to_contain_text("No session is found.")
    page.get_by_role("link", name="Plans").click()
    page.set_input_files("input[type=file]", root / "none.dcm")
    page.get_by_role("button", name="Import").click()
    expect(page.locator("#room [role=status]")).to_have_class("bad")
    page.set_input_files("input[type=file]", root / "plan.dcm")
    page.get_by_role("button", name="Import").click()
    expect(page.locator("#room [role=status]")).to_contain_text("LUNG_GATED of")
    expect(page.locator("tbody tr")).to_contain_text("gating")
    page.get_by_role("link", name="QA", exact=True).click()
    expect(page.locator("tbody tr").first).to_contain_text("passed")
    page.get_by_role("link", name="Audit log").click()
    page.get_by_role("button", name="Verify all rows").click()
    expect(page.locator("#room .good")).to_contain_text(re.compile(r"Intact: \d+ rows"))
    page.get_by_label("Action").fill("plan.import")
    page.get_by_role("button", name="Filter").click()
    expect(page.locator("tbody tr")).to_have_count(2, timeout=10_000)
    with page.expect_download() as export:
        page.get_by_role("link", name="Export the log").click()
    assert Path(export.value.path()).read_text().count("\n") > 5
    page.get_by_role("link", name="Machine").click()
    expect(page.locator("#room .good")).to_have_text("A session can run.")
    expect(page.locator("#room dl")).to_contain_text(f"Python {sys.version.split()[0]}")
    expect(page.locator("#room")).not_to_contain_text(PASSWORD)
    assert errors == []
