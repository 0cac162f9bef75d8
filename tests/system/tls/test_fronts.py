"""Page, stream, client and renewal over TLS: the service's own, behind nginx and Caddy, with a session under way."""

import asyncio
import http.client
import json
import re
import shutil
import ssl
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import httpx2
import pytest
from cryptography import x509
from playwright.sync_api import Browser, Error, Playwright, expect, sync_playwright
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import InvalidHandshake
from websockets.sync.client import connect

from service.client import TidegateClient
from tests.support.access.tls_certificate import make_certificate
from tests.support.browser.chromium import launch_chromium, trust
from tests.support.browser.tab import Tab
from tests.support.service.accounts import PASSWORD, SOMEBODY
from tests.support.service.tls_fronts import FRONTS, Front, fronted
from tests.support.stream.stream_server import messages, next_of
from tests.support.stream.tls_socket import TlsSocket
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = [pytest.mark.browser, pytest.mark.waiting]

SAMPLES = 45
OPENINGS = 3
MOST_WAITING = {"own": 40, "nginx": 200, "caddy": 2500}
"""Samples of 2 to 3 kB in all buffers for a client that reads nothing, by front. Caddy has no bound of its own: Linux's
4 MB per connection, 50 s of the stream (docs/3-operate/tls.md)."""


@pytest.fixture(scope="module", params=FRONTS)
def front(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Front]:
    with fronted(request.param, tmp_path_factory.mktemp(request.param)) as front:
        yield front


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def chromium(playwright: Playwright, front: Front, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser that trusts the front's certificate as it would a hospital's."""
    home = tmp_path_factory.mktemp("home")
    trust(home, front.cert)
    browser = launch_chromium(playwright, home=home)
    yield browser
    browser.close()


def enough(found: Iterator[dict]) -> list[dict]:
    """Take messages until there are enough samples."""
    taken, samples = [], 0
    while samples < SAMPLES:
        taken.append(next(found))
        samples += taken[-1]["type"] == "sample"
    return taken


def check_stream(found: list[dict]) -> None:
    """Check that every frame came once and in order, or is counted as dropped."""
    samples = [one for one in found if one["type"] == "sample"]
    assert len(samples) >= SAMPLES
    steps = [after["sequence"] - before["sequence"] for before, after in pairwise(samples)]
    assert min(steps) >= 1
    assert uncounted(found) == 0


def uncounted(found: list[dict]) -> int:
    """Return how many frames neither came nor are counted as dropped; negative where more are counted than missing."""
    numbers = [one["sequence"] for one in found if one["type"] == "sample"]
    missing = numbers[-1] - numbers[0] - (len(numbers) - 1)
    return missing - sum(one["skipped"] for one in found if one["type"] == "dropped")


def test_a_person_logs_in_on_the_page_and_its_stream_goes_on(front: Front, chromium: Browser):
    page = chromium.new_page()
    tab = Tab(page=page, url=front.url)
    tab.watch()
    tab.open("out")
    assert page.evaluate("isSecureContext")
    page.locator("#log-in").get_by_label("Name", exact=True).fill(SOMEBODY)
    page.locator("#log-in").get_by_label("Password", exact=True).fill(PASSWORD)
    page.keyboard.press("Enter")
    expect(page.locator("#person-name")).to_have_text(SOMEBODY, timeout=PATIENCE_S * 1e3)
    (cookie,) = page.context.cookies()
    assert (cookie["name"].startswith("__Host-"), cookie["secure"], cookie["httpOnly"]) == (True, True, True)
    seen = page.evaluate("traffic.sequence")
    tab.await_that(lambda: page.evaluate("traffic.sequence") > seen + SAMPLES, "the stream stands still")
    assert {url.partition(":")[0] for url in tab.requests} == {"https", "wss"}
    page.close()
    assert tab.complaints == []


def test_a_browser_that_does_not_trust_the_certificate_opens_no_page(front: Front, playwright: Playwright):
    browser = launch_chromium(playwright)
    page = browser.new_page()
    with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
        page.goto(front.url)
    browser.close()


def test_a_program_with_the_client_reads_calls_and_follows(front: Front):
    key = front.client.key_headers["Authorization"].removeprefix("Bearer ")
    with TidegateClient(front.url, key=key, ca_file=front.cert, operator=SOMEBODY) as tidegate:
        assert tidegate.readiness()["is_ready"]
        assert tidegate.hold(front.session_id)["gate"]["operator_hold"] is not None
        found = enough(tidegate.live(form="full"))
    check_stream(found)


def test_a_websocket_gets_every_sample(front: Front):
    url = f"wss://127.0.0.1:{front.port}/api/v1/live"
    with TlsSocket(url, front.client.key_headers, front.trusted) as socket:
        check_stream(enough(messages(socket)))


def events(answer: http.client.HTTPResponse) -> Iterator[dict]:
    for line in answer:
        if line.startswith(b"data: "):
            yield json.loads(line.removeprefix(b"data: "))


def test_server_sent_events_carry_every_sample(front: Front):
    connection = http.client.HTTPSConnection("127.0.0.1", front.port, context=front.trusted, timeout=PATIENCE_S)
    connection.request("GET", "/api/v1/live/events", headers=front.client.key_headers)
    check_stream(enough(events(connection.getresponse())))
    connection.close()


def test_a_slow_reader_is_reported_what_it_missed_and_goes_on_with_the_newest(front: Front):
    slow = front.slow_reader("/api/v1/live/events")
    front.await_rise("tidegate_live_skipped_total", 30)
    url = f"wss://127.0.0.1:{front.port}/api/v1/live?form=thin"
    with TlsSocket(url, front.client.key_headers, front.trusted) as other:
        newest = next(one["frame_index"] for one in messages(other) if one["type"] == "sample")
    answer = http.client.HTTPResponse(slow)
    answer.begin()
    found = []
    for one in events(answer):
        found.append(one)
        # Changes of the gate that waited come after the count of all that was dropped: some of it lies behind them.
        is_late = one["type"] == "sample" and one["frame_index"] > newest + SAMPLES
        if is_late and (uncounted(found) == 0 or one["frame_index"] > newest + 10 * SAMPLES):
            break
    slow.close()
    check_stream(found)
    waited = next(number for number, one in enumerate(found) if one["type"] == "dropped")
    assert waited <= MOST_WAITING[front.kind]


def test_a_socket_that_reads_nothing_is_closed_before_its_messages_are_old(front: Front):
    """A ping waits behind the unread messages, so that its answer is late, whatever a proxy buffers."""
    slow = front.slow_reader("/api/v1/live")
    closed = front.await_rise("tidegate_live_closed_total", 1)
    assert closed < 60
    slow.close()


async def watched(front: Front, trusted: ssl.SSLContext) -> list[dict]:
    """Take enough samples as a dashboard does: a connection that could not be opened is tried again."""
    url = f"wss://127.0.0.1:{front.port}/api/v1/live"
    for _ in range(OPENINGS):
        try:
            socket = await connect_async(
                url, additional_headers=front.client.key_headers, ssl=trusted, open_timeout=PATIENCE_S, max_queue=None
            )
            break
        except (OSError, InvalidHandshake) as error:
            refused = error
    else:
        raise AssertionError(f"{front.kind} opened no stream in {OPENINGS} attempts") from refused
    taken, samples = [], 0
    async with socket:
        while samples < SAMPLES:
            taken.append(json.loads(await socket.recv()))
            samples += taken[-1]["type"] == "sample"
    return taken


def test_many_clients_at_once_and_each_is_up_to_date(front: Front):
    """Fifteen dashboards, five of which read nothing: the others get every sample, or a count of those dropped."""
    stalled = [front.slow_reader("/api/v1/live") for _ in range(5)]

    async def all_watched() -> list[list[dict]]:
        trusted = front.trusted
        return await asyncio.wait_for(asyncio.gather(*(watched(front, trusted) for _ in range(10))), 2 * PATIENCE_S)

    # In a thread of its own: Playwright's event loop runs in this one.
    with ThreadPoolExecutor(1) as thread:
        found = thread.submit(lambda: asyncio.run(all_watched())).result()
    for one in found:
        check_stream(one)
    for one in stalled:
        one.close()


def shown(front: Front) -> int:
    """Return the serial number of the certificate that a new connection is shown."""
    text = ssl.get_server_certificate(("127.0.0.1", front.port), timeout=PATIENCE_S)
    return x509.load_pem_x509_certificate(text.encode()).serial_number


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Front]:
    with fronted("own", tmp_path) as front:
        yield front


def test_a_renewed_certificate_is_shown_without_a_restart_and_open_streams_go_on(own: Front, playwright, tmp_path):
    renewed, home = tmp_path / "renewed", tmp_path / "home"
    renewed.mkdir()
    make_certificate(renewed, ends_in=timedelta(days=90))
    for cert in (own.cert, renewed / "cert.pem"):
        trust(home / cert.parent.name, cert)
    first = shown(own)
    trusting_first = launch_chromium(playwright, home=home / own.cert.parent.name)
    trusting_second = launch_chromium(playwright, home=home / "renewed")
    tab = Tab(page=trusting_first.new_page(), url=own.url)
    tab.watch()
    tab.open("out")
    with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
        trusting_second.new_page().goto(own.url)
    url = f"wss://127.0.0.1:{own.port}/api/v1/live"
    with connect(
        url, additional_headers=own.client.key_headers, ssl=own.trusted, max_queue=None, open_timeout=PATIENCE_S
    ) as stream:
        next_of(stream, "sample")
        own.cert.write_text("cut off while it is copied")
        eventually(lambda: _warnings(own) == ["certificate_unreadable", "certificate_ends_soon"], pause_s=0.2)
        assert shown(own) == first
        for name in ("cert.pem", "key.pem"):
            shutil.copy(renewed / name, own.cert.with_name(name))
        eventually(lambda: shown(own) != first, pause_s=0.2, detail=lambda: "the old certificate is still shown")
        check_stream(enough(messages(stream)))
    Tab(page=trusting_second.new_page(), url=own.url).open("out")
    ends_at = x509.load_pem_x509_certificate(own.cert.read_bytes()).not_valid_after_utc.timestamp()
    with TidegateClient(own.url, key=_key(own), ca_file=own.cert) as tidegate:
        assert [one["code"] for one in tidegate.readiness()["warnings"] if "certificate" in one["code"]] == []
    with httpx2.Client(verify=own.trusted, headers=own.client.key_headers) as renewing:
        (line,) = re.findall(
            r"(?m)^tidegate_certificate_end_timestamp_seconds (\S+)$", renewing.get(f"{own.url}/metrics").text
        )
    assert float(line) == ends_at
    trusting_first.close()
    trusting_second.close()


def _key(front: Front) -> str:
    return front.client.key_headers["Authorization"].removeprefix("Bearer ")


def _warnings(front: Front) -> list[str]:
    found = front.client.get("/readyz", headers=front.client.key_headers).json()["warnings"]
    return [one["code"] for one in found if one["code"].startswith("certificate")]
