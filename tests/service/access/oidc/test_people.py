"""A person's whole way out and back, against a provider on this machine; then each thing that can be wrong on it."""

from datetime import timedelta
from urllib.parse import parse_qs, urlsplit

import httpx2
import pytest

from engine.core.clock import NS_PER_S, ManualClock
from service.access.oidc.http_client import ProviderClient
from service.access.oidc.pending_logins import PendingLogins
from service.access.oidc.people import AuthorizationResponse, NoRoleError, OidcPeople, names_of, roles_of
from service.access.oidc.provider import MIN_INTERVAL_S, Provider
from service.access.oidc.refusals import OidcReason, OidcRefusedError, OidcUnavailableError
from service.core.permissions import Role
from service.core.settings.oidc import OidcSettings
from tests.support.oidc.provider_server import running
from tests.support.oidc.site import utc_now
from tests.support.oidc.tokens import CLIENT, OTHER_KEY, part, published

pytestmark = pytest.mark.slow


class Site:
    """The part of the service that sends people out, without the service."""

    def __init__(self, settings: OidcSettings, now=utc_now) -> None:
        self.settings = settings
        self.clock = ManualClock(NS_PER_S)
        client = ProviderClient(
            client_id=settings.oidc_client_id, client_secret=settings.oidc_client_secret(), timeout_s=2.0
        )
        self.provider = Provider(
            issuer=settings.oidc_issuer, client=client, clock=self.clock, refresh_s=300.0, max_age_s=3600.0
        )
        self.provider.refresh()
        self.pending = PendingLogins(self.clock)
        self.people = OidcPeople(
            settings=settings, provider=self.provider, client=client, pending=self.pending, now=now
        )

    def out(self):
        """Go to the provider, and be sent back; return what the browser then brings, and its cookie."""
        departure = self.people.begin("127.0.0.1")
        with httpx2.Client(trust_env=False) as browser:
            back = browser.get(departure.url).headers["Location"]
        assert back.startswith(f"{self.settings.oidc_redirect_uri}?")
        reported = {name: values[0] for name, values in parse_qs(urlsplit(back).query).items()}
        returned = AuthorizationResponse(
            state=reported["state"], code=reported.get("code"), error=reported.get("error"), issuer=reported.get("iss")
        )
        return returned, departure.browser_secret

    def log_in(self):
        return self.people.finish(*self.out())

    def refused(self, returned=None, browser=None) -> OidcReason:
        arguments = self.out() if returned is None else (returned, browser)
        with pytest.raises(OidcRefusedError) as caught:
            self.people.finish(*arguments)
        return caught.value.reason


@pytest.fixture
def site(outside, oidc):
    return Site(OidcSettings(**oidc(outside)))


def test_a_person_comes_back_with_the_roles_of_the_groups(site, outside):
    person = site.log_in()
    assert (person.name, person.subject, person.issuer) == ("Jane Doe", "u-1", outside.issuer)
    assert person.roles == {Role.THERAPIST}


def test_a_client_without_a_secret_has_pkce_alone(outside, oidc, monkeypatch):
    monkeypatch.setattr("tests.support.oidc.provider_server.SECRET", "")
    site = Site(OidcSettings(**oidc(outside, oidc_client_secret_file=...)))
    outside._token_before = outside._token
    outside._token = lambda form, _basic: outside._token_before(form, f"{form.get('client_id')}:")
    assert site.log_in().subject == "u-1"


def test_a_provider_that_wants_the_secret_in_the_form_gets_it_there_and_not_in_a_header(outside, oidc):
    outside.description = {"token_endpoint_auth_methods_supported": ["private_key_jwt", "client_secret_post"]}
    assert Site(OidcSettings(**oidc(outside))).log_in().subject == "u-1"


def test_a_wrong_secret_grants_no_access(outside, oidc, secret_file):
    secret_file.write_text("another")
    assert Site(OidcSettings(**oidc(outside))).refused() == "code"


def test_roles_follow_the_groups_at_every_log_in(site, outside):
    outside.person["groups"] = ["physics", "it"]
    assert site.log_in().roles == {Role.PHYSICIST, Role.VIEWER, Role.ADMIN}
    outside.person["groups"] = "radiotherapy"
    assert site.log_in().roles == {Role.THERAPIST}


@pytest.mark.parametrize("groups", [[], ..., ["canteen"], ["Radiotherapy"], {"radiotherapy": 1}, [["radiotherapy"]], 7])
def test_a_person_without_a_mapped_group_is_refused_and_identified(site, outside, groups):
    outside.person["groups"] = groups
    with pytest.raises(NoRoleError) as caught:
        site.log_in()
    assert (caught.value.reason, caught.value.person.name) == ("no_role", "Jane Doe")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"iss": "http://127.0.0.1:1"}, "issuer"),
        ({"aud": "another-client"}, "audience"),
        ({"nonce": "of another log-in"}, "nonce"),
        ({"nonce": ...}, "nonce"),
        ({"exp": 1}, "expired"),
        ({"nbf": 9_999_999_999}, "not_yet_valid"),
        ({"at_hash": "bm90IHRoZSBoYXNo"}, "claims"),
        ({"name": ...}, "claims"),
        ({"name": ["Jane"]}, "claims"),
        ({"name": "tidegate"}, "claims"),
        ({"name": "T\uff29DEGATE"}, "claims"),
        ({"name": "Jane\u202eDoe"}, "claims"),
        ({"name": " \t "}, "claims"),
        ({"sub": ...}, "claims"),
    ],
    ids=str,
)
def test_a_token_with_one_lie_grants_no_access(site, outside, changes, reason):
    outside.changes = changes
    assert site.refused() == reason


def test_a_token_that_is_not_signed_grants_no_access(site, outside):
    def unsigned(token: str) -> str:
        return f"{part({'alg': 'none'})}.{token.split('.')[1]}."

    outside.forge = unsigned
    assert site.refused() == "algorithm"


def test_a_huge_token_grants_no_access(site, outside):
    outside.person["groups"] = [f"group-{number}" for number in range(2_000)]
    assert site.refused() == "malformed"


def test_an_unissued_state_grants_no_access(site):
    returned, browser = site.out()
    assert (
        site.refused(
            AuthorizationResponse(state="x" * 43, code=returned.code, error=None, issuer=returned.issuer), browser
        )
        == "state"
    )


def test_another_browser_with_the_code_and_the_state_does_not_get_in(site):
    returned, _ = site.out()
    assert site.refused(returned, "stolen from nowhere") == "state"


def test_what_came_back_once_does_not_come_back_again(site):
    returned, browser = site.out()
    site.people.finish(returned, browser)
    assert site.refused(returned, browser) == "state"


def test_a_code_that_was_used_is_refused_under_a_new_state_too(site):
    used, browser = site.out()
    site.people.finish(used, browser)
    fresh, browser = site.out()
    assert (
        site.refused(AuthorizationResponse(state=fresh.state, code=used.code, error=None, issuer=used.issuer), browser)
        == "code"
    )


def test_a_code_of_another_log_in_is_refused_since_the_verifier_is_another(site):
    theirs, _ = site.out()
    mine, browser = site.out()
    assert (
        site.refused(AuthorizationResponse(state=mine.state, code=theirs.code, error=None, issuer=mine.issuer), browser)
        == "code"
    )


def test_a_code_from_another_provider_is_not_shown_to_ours(site, outside):
    outside.on_return = {"iss": "https://evil.example"}
    assert site.refused() == "issuer"
    outside.on_return = {"iss": ""}  # it says that it always tells
    assert site.refused() == "issuer"
    assert "/token" not in outside.asked


def test_a_provider_that_states_no_is_reported_as_that(site, outside):
    outside.on_return = {"error": "access_denied", "code": ""}
    assert site.refused() == "provider_refused"
    outside.on_return = {"code": ""}
    assert site.refused() == "provider_refused"


def test_tokens_without_an_id_token_grant_no_access(site, outside):
    outside.trouble["/token"] = lambda: (200, {}, b'{"access_token": "a", "token_type": "Bearer"}')
    assert site.refused() == "malformed"


def test_a_key_that_was_rotated_a_minute_ago_is_fetched_while_the_person_waits(site, outside):
    site.clock.advance_ns(int(MIN_INTERVAL_S) * NS_PER_S)
    site.provider.start()
    outside.keys = [OTHER_KEY]
    try:
        assert site.log_in().subject == "u-1"
    finally:
        site.provider.stop()


def test_a_key_that_was_never_published_grants_no_access(site, outside):
    outside.keys = [OTHER_KEY]
    outside.trouble["/jwks"] = lambda: (200, {}, b'{"keys": []}')
    assert site.refused() == "unknown_key"


def test_a_provider_that_is_gone_is_reported_as_unavailable(oidc):
    with running() as gone:
        site = Site(OidcSettings(**oidc(gone)))
        returned = site.out()
    with pytest.raises(OidcUnavailableError):
        site.people.finish(*returned)


def test_a_provider_that_was_never_reached_gives_no_redirect(oidc):
    with running() as gone:
        pass
    with pytest.raises(OidcUnavailableError, match="does not answer"):
        Site(OidcSettings(**oidc(gone))).people.begin("127.0.0.1")


def test_a_clock_that_is_wrong_by_more_than_the_site_allows_grants_no_access(outside, oidc):
    ahead = Site(OidcSettings(**oidc(outside)), now=lambda: utc_now() + timedelta(seconds=400))
    behind = Site(OidcSettings(**oidc(outside)), now=lambda: utc_now() - timedelta(seconds=40))
    assert (ahead.refused(), behind.refused()) == ("expired", "not_yet_valid")


def test_two_people_of_one_name_are_distinguished_by_who_they_are():
    mine, theirs = names_of("Jane Doe", "i", "u-1"), names_of("Jane Doe", "i", "u-2")
    assert mine[0] == theirs[0] == "Jane Doe"
    assert mine[1] != theirs[1]
    assert mine == names_of("Jane Doe", "i", "u-1")


@pytest.mark.parametrize(
    "sign", "\u115f\u1160\u2800\u3164\uffa0\u200b\u00ad\u202e\u0000", ids=lambda sign: f"U+{ord(sign):04X}"
)
def test_no_name_has_an_invisible_character(sign):
    with pytest.raises(OidcRefusedError):
        names_of(f"Jane {sign}Doe", "i", "u")


def test_a_name_fits_into_the_audit_whatever_the_provider_calls_people():
    plain, marked = names_of("A/B:C " + "x" * 500, "i", "u")
    assert plain.startswith("A-B-C x")
    assert len(marked) <= 80


def test_too_many_groups_count_as_none():
    mapped = {"radiotherapy": frozenset({Role.THERAPIST})}
    assert roles_of(["radiotherapy"] * 1_000, mapped) == {Role.THERAPIST}
    assert roles_of(["radiotherapy"] * 1_001, mapped) == frozenset()


def test_nothing_of_the_secret_is_in_what_a_person_is_sent_to(site):
    url = site.people.begin("127.0.0.1").url
    query = parse_qs(urlsplit(url).query)
    assert query["client_id"] == [CLIENT]
    assert set(query) == {
        "response_type",
        "client_id",
        "redirect_uri",
        "scope",
        "state",
        "nonce",
        "code_challenge",
        "code_challenge_method",
    }
    [attempt] = site.pending._attempts.values()
    assert attempt.verifier not in url
    assert published(OTHER_KEY)  # and the provider's keys have no private half
