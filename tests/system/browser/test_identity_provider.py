"""A provider that is not ours, a real `tidegate serve`, real browsers: there and back, and with the provider killed."""

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import httpx2
import pytest
from playwright.sync_api import expect

from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.records import User
from service.access.accounts.store import AccessStore
from service.core.permissions import Role
from service.core.settings.oidc import RETURN_PATH
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.verification

BREAK_GLASS, PASSWORD = "Night Shift", "for when it is down"
START_S = 140.0
# Not the service's own address: to a browser these are two sites, as a hospital's are.
ISSUER = "http://localhost:{port}"
PEOPLE = (
    {"sub": "jdoe", "name": "Jane Doe", "groups": ["radiotherapy", "canteen"]},
    {"sub": "cook", "name": "C. Cook", "groups": ["canteen"]},
)


@contextlib.contextmanager
def provider_process(port: int, log: Path) -> Iterator[subprocess.Popen]:
    """Run a provider from the package index, in a process of its own: what it is built on warns when imported."""
    claims = [word for one in PEOPLE for word in ("--user-claims", json.dumps(one))]
    command = [sys.executable, "-W", "ignore", "-m", "oidc_provider_mock", "--port", str(port), "-n", "true", *claims]
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:

        def answers() -> bool:
            assert process.poll() is None, log.read_text()
            return _answers(ISSUER.format(port=port))

        eventually(answers, within_s=START_S, pause_s=0.05, detail=log.read_text)
        yield process
    finally:
        process.kill()
        process.wait()


def _answers(issuer: str) -> bool:
    try:
        return httpx2.get(f"{issuer}/jwks", trust_env=False).status_code == 200
    except httpx2.TransportError:
        return False


@dataclass
class Site:
    """A service, its provider, and how either is reached."""

    url: str
    issuer: str
    provider: subprocess.Popen

    def browser(self) -> httpx2.Client:
        return httpx2.Client(base_url=self.url, follow_redirects=True, trust_env=False, timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("real")
    provider_port, port = free_port(), free_port()
    issuer, url = ISSUER.format(port=provider_port), f"http://127.0.0.1:{port}"
    given = {
        "TIDEGATE_OIDC_ISSUER": issuer,
        "TIDEGATE_OIDC_CLIENT_ID": "tidegate",
        "TIDEGATE_OIDC_CLIENT_SECRET_FILE": str(folder / "secret"),
        "TIDEGATE_OIDC_REDIRECT_URI": f"{url}{RETURN_PATH}",
        "TIDEGATE_OIDC_GROUP_ROLES": "radiotherapy=therapist",
        "TIDEGATE_OIDC_LABEL": "the clinic",
    }
    (folder / "secret").write_text("any will do")
    keep_break_glass(folder / "data")
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(folder / "data"))
    with (
        provider_process(provider_port, folder / "provider.log") as provider,
        service_process(*arguments, port=port, log=folder / "service.log", environment=given) as (_, client),
    ):
        eventually(
            lambda: client.get("/api/v1/login/ways").json()["oidc"]["is_reachable"],
            within_s=START_S,
            pause_s=0.05,
            detail=(folder / "service.log").read_text,
        )
        yield Site(url=url, issuer=issuer, provider=provider)
        assert "any will do" not in (folder / "service.log").read_text()


def keep_break_glass(data: Path) -> None:
    data.mkdir()
    database = Database(Settings(data_dir=data).database_place)
    database.migrate()
    store = AccessStore(database)
    hashed = Argon2Hashing().hash(PASSWORD)
    user = User(name=BREAK_GLASS, password_hash=hashed, roles=frozenset({Role.THERAPIST}), created_at=store.now())
    store.write(save=[replace(user, is_break_glass=True)])
    database.close()


def test_a_person_goes_there_and_comes_back_logged_in(site):
    with site.browser() as browser:
        form = browser.get("/api/v1/login/oidc")
        assert str(form.url).startswith(f"{site.issuer}/oauth2/authorize?")
        page = browser.post(str(form.url), data={"sub": "jdoe"})
        assert (str(page.url), page.status_code) == (f"{site.url}/", 200)
        me = browser.get("/api/v1/me").json()
        assert (me["name"], me["roles"], me["way"]) == ("Jane Doe", ["therapist"], "oidc")
        back = str(page.history[0].headers["Location"])
        assert browser.get(back).status_code == 403  # the same way back, once more


# This provider leaves the state out where it refuses: nobody can know then which log-in that was.
@pytest.mark.parametrize(("choice", "code"), [({"sub": "cook"}, "no_role"), ({"action": "deny"}, "state")])
def test_somebody_without_a_role_and_somebody_who_is_refused_there_stay_out(site, choice, code):
    with site.browser() as browser:
        form = browser.get("/api/v1/login/oidc")
        page = browser.post(str(form.url), data=choice)
        assert (page.status_code, code in page.text) == (403, True)
        assert browser.get("/api/v1/me").status_code == 401


@pytest.mark.browser
def test_in_chromium_the_button_leads_there_and_back_to_a_page_that_knows_the_person(site, context):
    page = context.new_page()
    page.goto(site.url)
    page.get_by_role("button", name="Log in with the clinic").click()
    page.get_by_role("button", name="jdoe").click()
    page.wait_for_url(f"{site.url}/")
    expect(page.locator("body")).to_contain_text("Jane Doe")
    kept = {cookie["name"]: cookie for cookie in context.cookies(site.url)}
    assert set(kept) == {"tidegate_login"}
    assert (kept["tidegate_login"]["sameSite"], kept["tidegate_login"]["httpOnly"]) == ("Strict", True)
    page.close()


def test_with_the_provider_killed_only_a_break_glass_account_gets_in_and_those_who_are_in_stay(site):
    """Last in this file: the provider does not come back."""
    with site.browser() as inside, site.browser() as on_the_way, site.browser() as outside:
        form = inside.get("/api/v1/login/oidc")
        inside.post(str(form.url), data={"sub": "jdoe"})
        form = on_the_way.get("/api/v1/login/oidc")
        sent_back = on_the_way.post(str(form.url), data={"sub": "jdoe"}, follow_redirects=False)
        site.provider.kill()
        site.provider.wait()
        page = on_the_way.get(sent_back.headers["Location"])
        assert (page.status_code, "does not answer" in page.text) == (503, True)
        assert inside.get("/api/v1/me").json()["name"] == "Jane Doe"
        body = {"name": BREAK_GLASS, "password": PASSWORD}
        assert outside.post("/api/v1/login", json=body).json()["field"] == "reason"
        me = outside.post("/api/v1/login", json={**body, "reason": "the clinic's log-in is down"}).json()
        assert (me["name"], me["is_break_glass"]) == (BREAK_GLASS, True)
