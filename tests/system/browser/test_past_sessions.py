"""A past session is opened from the list while no session runs; its times are the screen's, with their zone."""

import re

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from service.core.permissions import Role
from tests.support.browser.accessibility import tint
from tests.support.browser.fake_service import FakeService, over, person
from tests.support.browser.served_tab import Door, opened_tab
from tests.support.browser.tab import Tab
from tests.support.service.accounts import PASSWORD
from tests.support.waiting import eventually

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NEWEST = over(patient_reference="P-0001")
OLDER = over("interrupted", patient_reference="P-0002") | {"id": "66" * 16}


def looks(fake: FakeService) -> int:
    """How often the page has read the list of sessions."""
    return sum(method == "GET" and path.endswith("/sessions") for method, path, _ in fake.calls)


def test_a_past_session_of_the_list_leads_to_its_review_beside_the_console(fake: FakeService, tab: Tab):
    fake.sessions[:] = [NEWEST, OLDER]
    page = tab.open("idle")
    expect(page.locator("#session-list .open", has_text="P-0002")).to_have_attribute(
        "href", f"office/#session/{OLDER['id']}"
    )
    with page.context.expect_page() as found:
        page.locator("#session-list .open", has_text="P-0002").click()
    expect(found.value.locator("h1")).to_contain_text("P-0002")
    assert "P-0002" not in page.locator("#report").inner_text()
    page.click("#setup-close")
    expect(page.locator("#report-review")).to_have_attribute("href", f"office/#session/{NEWEST['id']}")


@pytest.mark.parametrize(("zone", "time"), [("Asia/Kathmandu", "14:57:00 GMT+5:45"), ("UTC", "09:12:00 UTC")])
def test_times_are_the_screen_s_and_name_their_zone(
    fake: FakeService, chromium: Browser, door: tuple[Door, str], zone: str, time: str
):
    fake.sessions[:] = [NEWEST]
    context = chromium.new_context(timezone_id=zone, color_scheme="dark", viewport={"width": 1280, "height": 800})
    with opened_tab(fake, context, door) as tab:
        page = tab.open("idle")
        expect(page.locator("#report-when")).to_contain_text(f"started 21 Nov 2026, {time}")
        expect(page.locator("#session-list time").first).to_have_text(f"21 Nov 2026, {time}")
    context.close()


def past(fake: FakeService, tab: Tab, part: str = "") -> Page:
    fake.sessions[:] = [NEWEST, OLDER]
    page = tab.page
    page.goto(f"{tab.url}/office/#session/{OLDER['id']}{part}")
    expect(page.locator("#review-figures div")).not_to_have_count(0)
    expect(page.locator("#review-note")).to_have_text("")
    return page


def test_a_session_is_looked_at_again_with_its_trace_figures_and_what_can_be_taken_away(fake: FakeService, tab: Tab):
    page = past(fake, tab)
    expect(page.locator("h1")).to_have_text("P-0002 · PLAN-LUNG-4 · FX-03")
    expect(page.locator("#rooms a[aria-current]")).to_have_text("Sessions")
    for text in ("41.2 s", "34 %", "26 · 1.6 s", "±1.52 mm", "9.0 mm · 4.0 s", "41 · 3 / 5400", "31 ms"):
        expect(page.locator("#review-figures")).to_contain_text(text)
    for text in ("A. Therapist", "LUNG-4 · 1.2.3.4", "Room 2 · TrueBeam 4", "Astra 18042730123"):
        expect(page.locator("#review-head")).to_contain_text(text)
    expect(page.locator("#review-motion tr")).to_have_count(3)
    expect(page.locator("#review-motion tr").nth(1)).to_have_text("Whole+0.420.81±1.52")
    expect(page.locator("#review-holds tr").nth(1)).to_have_text("Outside the window3470.2 s")
    expect(page.locator("#review-look")).to_have_text("the beam line was simulated")
    page.get_by_text("Who did what").click()
    expect(page.locator("#review-acts li").first).to_contain_text("A. Therapistarmed")
    wanted = [f"/api/v1/sessions/{OLDER['id']}/{one}" for one in ("report.pdf", "report.html")]
    wanted += [f"/api/v1/sessions/{OLDER['id']}/samples?format={one}" for one in ("csv", "arrow", "parquet")]
    wanted.append(f"/api/v1/sessions/{OLDER['id']}/waveform.dcm")
    assert page.locator("#review-links a").evaluate_all("all => all.map(one => one.getAttribute('href'))") == wanted
    assert tint(page, "#review-frame canvas").spread > 100, "the trace is drawn"


def test_the_fractions_of_the_plan_stand_beside_each_other_and_lead_to_their_reviews(fake: FakeService, tab: Tab):
    past(fake, tab)
    fake.sessions.append(over(patient_reference="P-0002", fraction_id="FX-02") | {"id": "67" * 16})
    page = tab.page
    page.reload()
    expect(page.locator("#review-fractions svg > title")).to_have_text("2 fractions: window, breath and level")
    rows = page.locator("#review-fractions tbody tr")
    expect(rows.first).to_contain_text("1.5 to 2.0")
    page.locator("#review-fractions a").click()
    expect(page.locator("h1")).to_have_text("P-0002 · PLAN-LUNG-4 · FX-02")


def address(page: Page) -> str:
    """The address as it is now: Playwright's own is a moment late."""
    return str(page.evaluate("location.href"))


def test_the_address_leads_to_a_session_and_to_a_moment_in_it(fake: FakeService, tab: Tab):
    page = past(fake, tab)
    for key in ("+", "+", "+", "ArrowRight"):
        page.locator("#review-frame").press(key)
    looked = address(page)
    assert re.search(rf"#session/{OLDER['id']}/[\d.]+/[\d.]+$", looked)
    page.locator("#review-frame").press("Home")
    assert address(page).endswith(OLDER["id"])
    page.goto("about:blank")
    page.goto(looked)
    expect(page.locator("#review-note")).to_have_text("")
    assert address(page) == looked


def test_samples_that_cannot_be_read_are_reported(fake: FakeService, tab: Tab):
    tab.page.route(
        "**/report", lambda route: route.fulfill(status=410, json={"code": "samples_removed", "detail": "removed"})
    )
    fake.sessions[:] = [OLDER]
    tab.page.goto(f"{tab.url}/office/#session/{OLDER['id']}")
    expect(tab.page.locator("#review-note")).to_have_text("Not read: removed")


def test_a_report_is_noted_and_signed_by_who_looked_at_it(fake: FakeService, tab: Tab):
    fake.sessions[:] = [NEWEST]
    fake.report["signatures_needed"] = 2
    page = tab.page
    page.goto(f"{tab.url}/office/#session/{NEWEST['id']}")
    lines = page.locator("#review-signatures li")
    page.get_by_text("By cell, 95 % within, mm").click()
    expect(page.locator("#review-cells tr")).to_have_count(14)
    expect(page.locator("#review-cells tr").last.locator("td").last).to_have_text("2.0")
    bars = page.locator("#review-latency i")
    expect(bars).to_have_count(7)
    expect(bars.nth(2)).to_have_attribute("title", "10 to 15 ms: 1100 frames")
    heights = bars.evaluate_all("all => all.map((one) => one.getBoundingClientRect().height)")
    assert heights[2] == max(heights)
    assert heights[0] == 0
    expect(lines).to_have_text(["A limit was exceeded with a reason: two persons sign, 2 missing."])
    page.get_by_label("Note", exact=True).fill("coughed in the third minute")
    page.get_by_label("Note", exact=True).press("Enter")  # notes, and signs nothing
    expect(lines.first).to_contain_text("A. Therapist")
    expect(lines.first).to_contain_text("coughed in the third minute")
    page.get_by_label("Meaning").select_option("Checked")
    page.get_by_role("button", name="Sign report").click()  # without a password nothing is sent
    page.locator("#review-password input").fill(PASSWORD)
    page.locator("#review-password input").press("Enter")
    expect(lines.last).to_contain_text("1 missing")
    expect(lines.nth(1)).to_contain_text("Checked and signed by A. Therapist")
    expect(page.locator("#review-outcome")).to_have_text("Signed.")
    expect(page.get_by_role("button", name="Sign report")).to_be_hidden()
    noted, signed = (body for path, body in fake.posts() if path.endswith(("/note", "/signature")))
    assert (signed["meaning"], signed["password"]) == ("checked", PASSWORD)
    assert noted["content_sha256"] == signed["content_sha256"] == fake.report["content_sha256"]


def test_a_session_is_sent_to_the_pacs_and_says_how_far_it_is(fake: FakeService, tab: Tab):
    fake.office["/pacs"] = {"is_configured": True, "items": []}
    page = past(fake, tab)
    expect(page.locator("#review-sent")).to_have_text("")
    page.get_by_role("button", name="Send to PACS").click()
    expect(page.locator("#review-sent")).to_have_text("Waits to be sent, for A. Therapist.")
    (sent,) = (body for path, body in fake.posts() if path.endswith("/send"))
    assert sent["content_sha256"] == fake.report["content_sha256"]
    fake.office["/pacs"]["items"][0] |= {"trouble": "ARCHIVE does not answer", "tries": 3}
    page.reload()
    expect(page.locator("#review-sent")).to_contain_text("The last attempt: ARCHIVE does not answer.")
    at = fake._now()
    fake.office["/pacs"]["items"][0] |= {"state": "sent", "trouble": "", "sent_at": at, "committed_at": at}
    fake.person = person("V. Iewer", Role.VIEWER)
    page.reload()
    expect(page.locator("#review-sent")).to_contain_text("the PACS keeps it since")
    expect(page.locator("#review-send")).to_be_hidden()


def test_without_a_pacs_there_is_nothing_to_send_to(fake: FakeService, tab: Tab):
    page = past(fake, tab)
    expect(page.locator("#review-links a")).not_to_have_count(0)
    expect(page.locator("#review-pacs")).to_be_hidden()


def test_the_button_that_signs_stays_where_it_is_whatever_arrives_after_it(fake: FakeService, tab: Tab):
    other = NEWEST | {"id": OLDER["id"]}
    fake.sessions[:] = [NEWEST, other]
    page = tab.page
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route("**/moment?*", hold)
    page.route(f"**/{other['id']}/report*", hold)
    page.goto(f"{tab.url}/office/#session/{NEWEST['id']}")
    button = page.get_by_role("button", name="Sign report")
    expect(button).to_be_visible()
    eventually(lambda: page.wait_for_timeout(20) or len(held) == 2)
    at = button.bounding_box()
    for route in held:
        route.continue_()
    expect(page.locator("#review-fractions tbody tr")).to_have_count(2)
    expect(page.locator("#review-moment-text")).not_to_have_text("")
    expect(page.locator("#review-surface-note")).not_to_have_text("")
    assert button.bounding_box() == at


def test_who_may_not_sign_has_no_form_and_a_refusal_is_said(fake: FakeService, tab: Tab):
    fake.sessions[:] = [NEWEST]
    page = tab.page
    page.goto(f"{tab.url}/office/#session/{NEWEST['id']}")
    fake.problem = (409, {"code": "session_state", "detail": "A. Therapist has signed this report already"})
    page.get_by_label("Meaning").select_option("Approved")
    page.locator("#review-password input").fill(PASSWORD)
    page.get_by_role("button", name="Sign report").click()
    expect(page.locator("#review-outcome")).to_contain_text("has signed this report already")
    fake.person = person("V. Iewer", Role.VIEWER)
    page.reload()
    expect(page.locator("#review-signatures")).to_contain_text("Not signed yet.")
    expect(page.locator("#review-sign")).to_be_hidden()


def test_the_moment_at_the_pointer_has_its_values_its_surface_and_its_cells(fake: FakeService, tab: Tab):
    page = past(fake, tab)
    box = page.locator("#review-frame .u-over").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 40)
    # A fake session of two minutes: at 90 s a breath is deepest.
    expect(page.locator("#review-moment-text")).to_have_text(
        re.compile(r" · (89|90)\.\d\d s · outside window · Whole \+(9\.[5-9]|10\.0) mm")
    )
    eventually(lambda: tint(page, "#review-surface canvas").spread > 20, detail=lambda: "the surface is not drawn")
    expect(page.locator("#review-surface-note")).to_contain_text("To scale")
    expect(page.locator("#review-surface .side")).to_have_text(["Head", "R", "L", "5 cm"])
    head, right, left = (page.locator("#review-surface .side").nth(i).bounding_box() for i in range(3))
    assert head["y"] < min(right["y"], left["y"])
    assert right["x"] < left["x"]
    cells = page.locator("#review-grid").bounding_box()
    assert cells is not None
    page.locator("#review-grid").hover(position={"x": cells["width"] / 2, "y": cells["height"] - 6})
    expect(page.locator("#review-readout")).to_contain_text("row 13, column")
    before = page.locator("#review-surface").screenshot()
    page.locator("#review-surface").press("ArrowRight")
    eventually(lambda: page.locator("#review-surface").screenshot() != before, detail=lambda: "it does not turn")


def test_a_browser_without_webgl_shows_the_cells(fake: FakeService, tab: Tab):
    tab.page.add_init_script(
        "HTMLCanvasElement.prototype.getContext = new Proxy(HTMLCanvasElement.prototype.getContext, "
        "{apply: (call, canvas, given) => given[0].startsWith('webgl') ? null : Reflect.apply(call, canvas, given)})"
    )
    page = past(fake, tab)
    expect(page.locator("#review-surface-note")).to_contain_text("no WebGL")
    page.locator("#review-frame .u-over").hover(position={"x": 30, "y": 40})
    eventually(lambda: tint(page, "#review-grid").spread > 20, detail=lambda: "the cells are not drawn")


def test_a_part_of_the_trace_is_read_at_its_scale_and_an_act_leads_to_its_part(fake: FakeService, tab: Tab):
    asked: list[str] = []
    tab.page.on("request", lambda request: asked.append(request.url) if "/trace?" in request.url else None)
    fake.seconds = 3600.0  # an hour
    page = past(fake, tab)
    assert len(asked) == 1
    page.get_by_text("Who did what").click()
    page.locator("#review-acts button").first.click()
    eventually(lambda: address(page).endswith("/30.00/60.00"), detail=lambda: address(page))
    expect(page.locator("#review-moment-text")).to_contain_text("40.00 s")
    eventually(lambda: len(asked) > 1, detail=lambda: asked)
    assert "from_s=15&to_s=75&" in asked[1], "the part with half of it on either side"
    for _ in range(2):
        page.locator("#review-frame").press("ArrowRight")
    page.wait_for_timeout(200)
    assert len(asked) == 2, "what was read beside the part is enough"


def test_rows_of_the_work_list_stay_while_nothing_changes(fake: FakeService, tab: Tab):
    fake.sessions[:] = [NEWEST, OLDER]
    page = tab.open("idle")
    row = page.locator("#session-list .open", has_text="P-0002").element_handle()
    assert row is not None
    before = looks(fake) + 1
    page.fill("#work-search", "P-000")
    eventually(lambda: sum(path.endswith("/sessions") for _, path, _ in fake.calls) > before, detail=lambda: fake.calls)
    page.wait_for_timeout(100)
    assert row.evaluate("one => one.isConnected"), "a click that began on it is not lost"
    fake.sessions.pop()
    page.fill("#work-search", "P-00")
    expect(page.locator("#session-list .open")).to_have_count(1)
