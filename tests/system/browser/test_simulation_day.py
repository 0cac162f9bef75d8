"""The simulation day: signed before the start, its breath beside today's, its window taken into the editor."""

import base64
import math
import re

import pytest
from playwright.sync_api import expect

from service.core.schemas.simulations import Simulation
from tests.support.browser.fake_service import PROPOSAL, SESSION, FakeService, over, sample
from tests.support.browser.tab import Tab
from tests.support.service.accounts import PASSWORD

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DAY = over() | {"id": "66" * 16, "plan_id": "CT"}
FOUND = {
    "of_session": SESSION["id"],
    "origin": "session",
    "session_id": DAY["id"],
    "file_sha256": None,
    "begun_at": "2026-11-20T09:12:00Z",
    "signal": "whole",
    "peak_to_peak_mm": 11.2,
    "end_exhale_mm": 0.1,
    "end_inhale_mm": 9.4,
    "period_s": 4.2,
    "lower_percent": -12.0,
    "upper_percent": 31.0,
    "window_from": "window",
    "has_position": True,
    "trace": [[round(0.1 * i, 1), round(4.65 * (1.0 - math.cos(0.15 * i)), 2)] for i in range(599)],
    "signed_by": "P. Physicist",
    "signed_at": "2026-11-21T07:00:00Z",
    "confirmed_by": "password",
}
DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
MINUS, DASH = "\N{MINUS SIGN}", "\N{EN DASH}"
EXHALE = PROPOSAL | {"level": -1.0, "percent": 0.0}
INHALE = PROPOSAL | {"at": "end_inhale", "level": 9.0, "percent": 100.0}


def signed(fake: FakeService) -> None:
    Simulation.model_validate_json(Simulation(**FOUND).model_dump_json())
    fake.office[f"/sessions/{SESSION['id']}/simulation"] = FOUND


def test_its_breath_stands_beside_today_s_and_its_window_goes_into_the_editor_not_onto_the_gate(
    fake: FakeService, tab: Tab
):
    signed(fake)
    fake.mode, fake.sample = "samples", DISARMED
    fake.sessions[0]["reference_proposals"] = [EXHALE, INHALE]
    page = tab.open("disarmed")
    page.click("#do-simulation")
    note = page.locator("#simulation-note")
    expect(note).to_contain_text("signed by P. Physicist")
    expect(note).to_contain_text("Its position is compared")
    rows = [row.inner_text().split("\t") for row in page.locator("#simulation-table tr").all()]
    assert [row[1] for row in rows] == ["Simulation day", "9.3", "4.2", "11.2", f"{MINUS}12 {DASH} 31 %"]
    for line in ("then", "now"):
        expect(page.locator(f"#simulation-{line}")).to_have_attribute("points", re.compile(r"^\d+\.\d,"))
    page.click("#simulation-window")
    expect(page.locator("#simulation")).to_be_hidden()
    expect(page.locator("#window-editor [name=lower]")).to_have_value("-12")
    expect(page.locator("#window-editor [name=upper]")).to_have_value("31")
    expect(page.locator("[name=unit]")).to_have_value("percent")
    assert not [path for path, _ in fake.posts() if path.endswith("/window")], "a person applies it"


def test_before_the_start_a_session_or_a_file_is_signed_with_the_password(fake: FakeService, tab: Tab):
    created = SESSION | {"status": "created", "started_at": None}
    fake.sessions[:] = [created, DAY]
    page = tab.open("idle")
    page.click("#do-simulation")
    form = page.locator("#simulation-form")
    expect(form).to_be_visible()
    form.locator("[type=submit]").click()
    expect(page.locator("#simulation-outcome")).to_have_text("Choose a session or a file")
    form.locator("[name=file]").set_input_files({"name": "a.vxp", "mimeType": "text/plain", "buffer": b"[Header]"})
    form.locator("[name=own_password]").fill(PASSWORD)
    form.locator("[type=submit]").click()
    expect(form.locator("[name=own_password]")).to_have_value("")
    form.locator("[name=session]").select_option(DAY["id"])
    form.locator("[name=own_password]").fill(PASSWORD)
    form.locator("[type=submit]").click()
    expect(form.locator("[name=own_password]")).to_have_value("")
    sent = [body for path, body in fake.posts() if path.endswith("/simulation")]
    own = {"operator": "A. Therapist", "password": PASSWORD}
    assert sent == [own | {"file": base64.b64encode(b"[Header]").decode()}, own | {"session_id": DAY["id"]}]
    page.keyboard.press("Escape")
    expect(page.locator("#simulation")).to_be_hidden()
