"""The header names the room, as text, whatever the name is."""

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import FakeService
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


def test_the_header_names_the_room(fake: FakeService, tab: Tab):
    fake.mode, fake.room = "idle", "<b>2</b>"
    page = tab.open("idle")
    name = page.locator("header #room-name")
    expect(name).to_have_text("<b>2</b>")
    expect(name).to_be_visible()


def test_a_room_without_a_name_has_no_text(fake: FakeService, tab: Tab):
    fake.mode, fake.room = "idle", None
    expect(tab.open("idle").locator("#room-name")).to_have_text("")
