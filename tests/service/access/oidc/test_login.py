"""Log-ins at the provider through the service's own routes: who gets in, as whom, and what the audit says of it."""

from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit

import httpx2
import pytest
from fastapi.testclient import TestClient

from engine.core.clock import MonotonicClock
from service.access.accounts.records import User
from service.access.oidc.pending_logins import FailureLimiter
from service.access.oidc.service import MAX_CONCURRENT
from service.core.permissions import Role
from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.oidc.provider_server import SECRET, Provider, running
from tests.support.oidc.site import GROUPS, SCOPES
from tests.support.oidc.tokens import AUDIENCE, CLIENT, ISSUER
from tests.support.service.accounts import PASSWORD, QuickHashing
from tests.support.service.fake_engine import FakeEngine
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

OUT, BACK, WAYS = "/api/v1/login/oidc", "/api/v1/login/oidc/return", "/api/v1/login/ways"
REASON = "the provider is down since 7 o'clock"


@contextmanager
def service(data_dir, *, is_awaited=True, **given):
    settings = Settings(data_dir=data_dir, allowed_hosts=("testserver",), **given)
    with TestClient(create_app(settings, lambda _settings: FakeEngine()), follow_redirects=False) as client:
        client.app.state.access.logins._hashing = QuickHashing()
        if given and is_awaited:
            eventually(lambda: client.get(WAYS).json()["oidc"]["is_reachable"])
        yield client


@pytest.fixture
def start(tmp_path, oidc):
    """Start a service with settings of the test's own."""
    with ExitStack() as stack:

        def start(provider, *, is_awaited=True, **changes) -> TestClient:
            given = oidc(provider, **changes) if provider else {}
            return stack.enter_context(service(tmp_path / "data", is_awaited=is_awaited, **given))

        yield start


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """One provider and one service for all tests that change neither's settings."""
    folder = tmp_path_factory.mktemp("oidc")
    (folder / "client-secret").write_text(SECRET)
    with (
        running() as provider,
        service(
            folder / "data",
            oidc_issuer=provider.issuer,
            oidc_client_id=CLIENT,
            oidc_client_secret_file=folder / "client-secret",
            oidc_redirect_uri=f"http://localhost{BACK}",
            oidc_group_roles=GROUPS,
            oidc_machine_audience=AUDIENCE,
            oidc_machine_scopes=SCOPES,
        ) as client,
    ):
        yield provider, client


@pytest.fixture
def outside(shared):
    """The shared provider, honest again."""
    provider, _ = shared
    fresh = Provider(issuer=provider.issuer)
    provider.__dict__.update(fresh.__dict__)
    return provider


@pytest.fixture
def client(shared, outside):
    """A browser at the shared service, in which no one has been yet."""
    _, client = shared
    store, refused_logins = client.app.state.access.store, client.app.state.access.refused_logins
    store.write(drop=[*store.logins.values(), *store.attempts.values()])
    store.write(drop=list(store.users.values()))
    refused_logins.take_events()
    refused_logins.take_summary()
    client.cookies.clear()
    client.mark = newest(client)
    return client


def newest(client: TestClient) -> int:
    return client.app.state.services.audit.page(None, 1, None).items[0].sequence


def go(client: TestClient) -> str:
    """Go to the provider; return where it sends the browser back to."""
    out = client.get(OUT)
    assert out.status_code == 303, out.text
    with httpx2.Client(trust_env=False) as browser:
        back = urlsplit(browser.get(out.headers["Location"]).headers["Location"])
    return f"{back.path}?{back.query}"


def log_in(client: TestClient):
    return client.get(go(client))


def refusals(client: TestClient):
    """The refused log-ins: those that the service has written by now, and those that wait for it."""
    written = [row.detail for row in audit(client, "user.login") if row.outcome == "refused"]
    return written + [event.detail for event in client.app.state.access.refused_logins.take_events()]


def audit(client: TestClient, action: str):
    rows = client.app.state.services.audit.page(None, 100, None).items
    return [row for row in rows if row.action == action and row.sequence > getattr(client, "mark", 0)]


def local(client: TestClient, name: str = "Night Shift", **fields) -> None:
    store = client.app.state.access.store
    user = User(
        name=name,
        password_hash=f"quick:{PASSWORD}",
        roles=frozenset({Role.THERAPIST}),
        created_at=datetime.now(UTC),
        **fields,
    )
    store.write(save=[user])


def by_password(client: TestClient, name: str = "Night Shift", **fields):
    body = {"name": name, "password": PASSWORD, **fields}
    return client.post("/api/v1/login", json=body, headers={"Origin": "http://testserver"})


def test_a_person_gets_in_as_the_provider_states_and_with_the_roles_of_the_groups(client):
    back = log_in(client)
    assert (back.status_code, back.headers["Location"]) == (303, "/")
    me = client.get("/api/v1/me").json()
    assert (me["name"], me["kind"], me["way"], me["roles"]) == ("Jane Doe", "oidc", "oidc", ["therapist"])
    assert not me["is_break_glass"]
    assert client.get("/api/v1/sessions").status_code == 200
    assert client.get("/api/v1/users").status_code == 403


def test_the_cookies_are_out_of_reach_of_scripts_and_the_one_on_the_way_lasts_as_long_as_the_way(client):
    out = client.get(OUT)
    [on_the_way] = out.headers.get_list("set-cookie")
    assert on_the_way.startswith("tidegate_oidc=")
    for flag in ("HttpOnly", "SameSite=lax", "Path=/", "Max-Age=300"):
        assert flag in on_the_way
    for_good, dropped = log_in(client).headers.get_list("set-cookie")
    assert for_good.startswith("tidegate_login=")
    assert {"HttpOnly", "SameSite=strict"} <= set(for_good.split("; "))
    assert dropped.startswith('tidegate_oidc=""; ')
    assert "Max-Age=0" in dropped


def test_behind_tls_both_cookies_are_bound_to_this_very_host(start, outside):
    client = start(outside, behind_proxy=True, oidc_redirect_uri=f"https://localhost{BACK}")
    client.base_url = "https://testserver"
    out = client.get(OUT).headers["set-cookie"]
    assert out.startswith("__Host-tidegate_oidc=")
    assert "Secure" in out
    for_good, _ = log_in(client).headers.get_list("set-cookie")
    assert for_good.startswith("__Host-tidegate_login=")
    assert "Secure" in for_good


def test_who_got_in_and_by_which_subject_is_audited_and_no_secret_is(client, outside):
    back = go(client)
    client.get(back)
    [row] = audit(client, "user.login")
    assert (row.actor, row.outcome) == ("Jane Doe", "done")
    assert row.detail["subject"] == "u-1"
    assert row.detail["roles"] == ["therapist"]
    query = parse_qs(urlsplit(back).query)
    everything = str([entry.model_dump() for entry in client.app.state.services.audit.page(None, 100, None).items])
    for secret in (query["code"][0], query["state"][0], client.cookies["tidegate_login"], "the client's secret"):
        assert secret not in everything


def test_roles_are_those_of_today_in_every_log_in_of_the_person(client, outside):
    log_in(client)
    outside.person["groups"] = ["physics"]
    old = dict(client.cookies)
    client.cookies.clear()
    log_in(client)
    assert client.get("/api/v1/me").json()["roles"] == ["physicist", "viewer"]
    client.cookies.clear()
    client.cookies.update(old)
    assert client.get("/api/v1/me").json()["roles"] == ["physicist", "viewer"]


def test_a_person_without_a_mapped_group_is_refused_and_named_in_the_refusal(client, outside):
    outside.person["groups"] = ["canteen"]
    back = log_in(client)
    assert back.status_code == 403
    assert "None of your groups" in back.text
    assert client.get("/api/v1/me").status_code == 401
    [detail] = refusals(client)
    assert (detail["reason"], detail["subject"], detail["claimed_name"]) == ("no_role", "u-1", "Jane Doe")
    assert not client.app.state.access.store.users.keys() & {"jane doe"}


def test_somebody_who_is_disabled_here_stays_out_whatever_the_provider_states(client):
    log_in(client)
    store = client.app.state.access.store
    store.write(save=[replace(store.users["jane doe"], is_disabled=True)])
    assert client.get("/api/v1/me").status_code == 401
    back = log_in(client)
    assert back.status_code == 403
    assert "disabled here" in back.text
    assert refusals(client)[-1]["reason"] == "disabled"


def test_two_people_of_one_name_are_two(client, outside):
    log_in(client)
    outside.person["sub"] = "u-2"
    client.cookies.clear()
    log_in(client)
    second = client.get("/api/v1/me").json()["name"]
    assert second.startswith("Jane Doe [")
    outside.person["sub"] = "u-1"
    client.cookies.clear()
    log_in(client)
    assert client.get("/api/v1/me").json()["name"] == "Jane Doe"


def test_a_name_at_the_provider_does_not_make_somebody_a_person_who_is_here(client, outside):
    local(client, name="Night Shift", is_break_glass=True)
    outside.person["name"] = "NIGHT shift"
    log_in(client)
    me = client.get("/api/v1/me").json()
    assert me["name"].startswith("NIGHT shift [")
    assert client.app.state.access.store.users["night shift"].issuer is None


def test_one_subject_of_two_providers_is_two_people(client, start, outside):
    log_in(client)
    store = client.app.state.access.store
    store.write(save=[replace(store.users["jane doe"], issuer=ISSUER)])
    client.cookies.clear()
    log_in(client)
    assert client.get("/api/v1/me").json()["name"].startswith("Jane Doe [")


def test_a_person_of_the_provider_has_no_password_here(client):
    log_in(client)
    client.cookies.clear()
    for password in (PASSWORD, "None", "quick:None"):
        answer = client.post(
            "/api/v1/login",
            json={"name": "Jane Doe", "password": password, "reason": REASON},
            headers={"Origin": "http://testserver"},
        )
        assert answer.status_code == 401


def test_what_came_back_once_does_not_come_back_again(client):
    back = go(client)
    kept = dict(client.cookies)
    assert client.get(back).status_code == 303
    client.cookies.clear()
    client.cookies.update(kept)
    again = client.get(back)
    assert again.status_code == 403
    assert client.get("/api/v1/me").status_code == 401


def test_a_return_address_of_another_browser_starts_no_log_in(client, start):
    back = go(client)
    client.cookies.clear()  # the victim's browser has never begun anything
    assert client.get(back).status_code == 403
    assert "tidegate_login" not in client.cookies


@pytest.mark.parametrize(
    "query",
    [
        "",
        "?state=",
        "?state=x",
        "?code=x",
        "?state=x&code=y&iss=https://evil.example",
        "?state=" + "x" * 201,
        "?state[]=x",
    ],
)
def test_a_return_without_a_pending_log_in_grants_no_access_and_writes_no_audit_row(client, query):
    answer = client.get(BACK + query)
    assert answer.status_code in {403, 422}
    assert refusals(client) == []
    assert not answer.headers.get("Location")


def test_nothing_that_comes_from_outside_stands_in_the_page_of_a_refusal(client, outside):
    outside.on_return = {"error": "<script>alert(1)</script>", "error_description": "<img src=x>", "code": ""}
    page = log_in(client)
    assert page.status_code == 403
    assert "<script" not in page.text
    assert "<img" not in page.text
    assert "default-src 'self'" in page.headers["Content-Security-Policy"]
    assert page.headers["Cache-Control"] == "no-store"


@pytest.mark.parametrize("elsewhere", ["next=//evil.example", "redirect_uri=https://evil.example", "return_to=/\\evil"])
def test_there_is_no_redirect_to_other_sites_after_the_log_in(client, elsewhere):
    assert client.get(f"{go(client)}&{elsewhere}").headers["Location"] == "/"


def test_where_people_come_back_to_is_not_taken_from_the_host_header(client):
    out = client.get(OUT, headers={"X-Forwarded-Host": "evil.example", "Forwarded": "host=evil.example"})
    assert parse_qs(urlsplit(out.headers["Location"]).query)["redirect_uri"] == [f"http://localhost{BACK}"]
    assert client.get(OUT, headers={"Host": "evil.example"}).status_code == 421


def test_a_log_in_in_an_attacker_s_name_is_not_slipped_into_a_browser_that_has_one(client, outside):
    log_in(client)
    mine = client.cookies["tidegate_login"]
    outside.person = {"sub": "attacker", "name": "Mallory", "groups": ["radiotherapy"]}
    theirs = TestClient(client.app, follow_redirects=False)
    back = go(theirs)
    assert client.get(back).status_code == 403
    assert client.cookies["tidegate_login"] == mine


def test_a_cookie_that_was_planted_before_the_log_in_is_not_the_one_after_it(client):
    client.cookies.set("tidegate_login", "planted", domain="testserver.local", path="/")
    log_in(client)
    tokens = [cookie.value for cookie in client.cookies.jar if cookie.name == "tidegate_login"]
    assert client.get("/api/v1/me", headers={"Cookie": "tidegate_login=planted"}).status_code == 401
    assert any(len(token) >= 43 for token in tokens)


def test_no_more_people_are_asked_about_at_once_than_leave_threads_for_a_stop(client):
    desk = client.app.state.oidc
    for _ in range(MAX_CONCURRENT):
        assert desk._slots.acquire(blocking=False)
    answer = log_in(client)
    assert answer.status_code == 503
    assert "Too many" in answer.text
    for _ in range(MAX_CONCURRENT):
        desk._slots.release()
    assert log_in(client).status_code == 303


def test_codes_that_are_made_up_are_not_shown_to_the_provider_without_end(client, outside, monkeypatch):
    monkeypatch.setattr("service.access.oidc.pending_logins.MAX_FAILURES", 3)
    monkeypatch.setattr(client.app.state.oidc, "_failure_limiter", FailureLimiter(MonotonicClock()))
    outside.on_return = {"code": "made up"}
    assert [log_in(client).status_code for _ in range(5)] == [403, 403, 403, 503, 503]
    assert outside.asked.count("/token") == 3


def test_every_seat_is_given_back_whatever_came_of_it(client, outside):
    outside.changes = {"aud": "another"}
    for _ in range(MAX_CONCURRENT + 1):
        assert log_in(client).status_code == 403
    outside.changes = {}
    assert log_in(client).status_code == 303


def test_without_a_provider_the_page_offers_a_password_and_the_routes_lead_nowhere(start):
    client = start(None)
    assert client.get(WAYS).json() == {"password": True, "local_accounts": "all", "oidc": None}
    assert client.get(OUT).status_code == 403
    assert "does not use the provider" in client.get(f"{BACK}?state=x&code=y").text


def test_the_page_gets_the_permitted_controls(client):
    assert client.get(WAYS).json() == {
        "password": True,
        "local_accounts": "break-glass",
        "oidc": {"label": "the hospital's log-in", "is_reachable": True},
    }


def test_a_service_starts_at_once_although_the_provider_is_down(start, outside):
    outside.trouble["/.well-known/openid-configuration"] = lambda: (500, {}, b"")
    client = start(outside, is_awaited=False)
    answer = client.get(OUT)
    assert answer.status_code == 503
    assert "does not answer" in answer.text


def test_a_break_glass_account_gets_in_with_a_reason_and_everything_states_it(client):
    local(client, is_break_glass=True)
    before = broken_glass(client)
    assert by_password(client).json()["field"] == "reason"
    answer = by_password(client, reason=REASON)
    assert answer.status_code == 200
    assert answer.json()["is_break_glass"]
    assert client.get("/api/v1/me").json()["is_break_glass"]
    [row] = audit(client, "user.break_glass")
    assert (row.actor, row.detail["reason"]) == ("Night Shift", REASON)
    assert broken_glass(client) == before + 1.0


def broken_glass(client: TestClient) -> float:
    text = client.app.state.services.metrics.text()[0].decode()
    [line] = [line for line in text.splitlines() if line.startswith("tidegate_break_glass_logins_total ")]
    return float(line.split()[1])


def test_other_accounts_of_our_own_are_refused_once_their_password_was_right(client):
    local(client)
    answer = by_password(client, reason=REASON)
    assert (answer.status_code, answer.json()["code"]) == (403, "local_login_refused")
    assert refusals(client)[-1]["reason"] == "local"
    wrong = client.post(
        "/api/v1/login", json={"name": "Night Shift", "password": "wrong"}, headers={"Origin": "http://testserver"}
    )
    unknown = client.post(
        "/api/v1/login", json={"name": "Nobody Here", "password": "wrong"}, headers={"Origin": "http://testserver"}
    )
    assert wrong.status_code == unknown.status_code == 401
    assert wrong.json() == unknown.json()


def test_the_first_administrator_of_a_new_folder_gets_in_although_people_log_in_at_the_provider(
    tmp_path, outside, oidc
):
    reported = {}
    settings = Settings(data_dir=tmp_path / "data", allowed_hosts=("testserver",), **oidc(outside))
    app = create_app(settings, lambda _settings: FakeEngine(), tell_first=reported.__setitem__)
    with TestClient(app) as client:
        [(name, password)] = reported.items()
        body = {"name": name, "password": password, "reason": "the first start"}
        assert client.post("/api/v1/login", json=body).json()["must_change_password"]


def test_a_site_may_let_its_other_accounts_in(start, outside):
    client = start(outside, oidc_local_accounts="all")
    local(client)
    assert by_password(client).status_code == 200
    assert not audit(client, "user.break_glass")


def test_a_machine_comes_in_with_the_provider_s_token_and_may_what_its_scopes_say(client, outside):
    token = machine_token(outside)
    bearer = {"Authorization": f"Bearer {token}"}
    assert client.get("/api/v1/me", headers=bearer).json()["name"] == "machine:rvs"
    assert client.get("/api/v1/sessions", headers=bearer).status_code == 200
    assert client.get("/api/v1/audit", headers=bearer).status_code == 403
    assert client.get("/api/v1/sessions", headers={"Authorization": f"Bearer {token[:-4]}AAAA"}).status_code == 401
    assert client.get("/api/v1/sessions", headers={"Authorization": f"Bearer {'x' * 20_000}"}).status_code == 401


def test_what_a_machine_has_open_ends_with_its_token(client, outside):
    access = client.app.state.access
    identity = access.authenticator.machine_verifier.identify(machine_token(outside))
    assert access.authenticator.is_valid(identity)
    over = replace(identity, until=access.store.now())
    assert not access.authenticator.is_valid(over)


def machine_token(outside) -> str:
    from authlib.integrations.httpx_client import OAuth2Client

    quoted = SECRET.replace("%", "%25").replace("&", "%26").replace("+", "%2B").replace(" ", "+").replace(",", "%2C")
    with OAuth2Client(client_id=CLIENT, client_secret=quoted.replace("'", "%27"), trust_env=False) as machine:
        return machine.fetch_token(f"{outside.issuer}/token", grant_type="client_credentials")["access_token"]


def test_a_machine_s_token_is_never_passed_over_for_a_cookie(client, outside):
    log_in(client)
    answer = client.get("/api/v1/me", headers={"Authorization": "Bearer not.a.token"})
    assert answer.status_code == 401
