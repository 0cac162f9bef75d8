"""Machines with a token of the provider: judged from memory, and never more than a machine may."""

from datetime import timedelta

import pytest

from engine.core.clock import NS_PER_S, ManualClock
from service.access.oidc.provider import MIN_INTERVAL_S, Provider
from service.access.oidc.refusals import OidcReason, OidcRefusedError, OidcUnavailableError
from service.access.oidc.service import OidcMachines, permissions_of
from service.core.permissions import Permission
from service.core.settings.oidc import OidcSettings
from tests.support.oidc.fake_source import FakeSource
from tests.support.oidc.site import SCOPES
from tests.support.oidc.tokens import (
    AUDIENCE,
    CLIENT,
    ISSUER,
    NOW,
    NOW_S,
    OTHER_KEY,
    machine_claims,
    machine_token,
    person_claims,
    published,
    signed,
)


class Verifier:
    """Machines at the door of a site whose provider answers, until it does not."""

    def __init__(self, **changes) -> None:
        self.source = FakeSource()
        self.clock = ManualClock(NS_PER_S)
        self.now = NOW
        settings = OidcSettings(
            oidc_issuer=ISSUER, oidc_machine_audience=AUDIENCE, **{"oidc_machine_scopes": SCOPES, **changes}
        )
        self.provider = Provider(issuer=ISSUER, client=self.source, clock=self.clock, refresh_s=300.0, max_age_s=3600.0)
        self.provider.refresh()
        self.machines = OidcMachines(settings=settings, provider=self.provider, now=lambda: self.now)

    def refused(self, token: str) -> OidcReason:
        assert self.machines.identify(token) is None
        with pytest.raises(OidcRefusedError) as caught:
            self.machines.check(token)
        return caught.value.reason


@pytest.fixture
def verifier():
    return Verifier()


def test_a_machine_may_do_what_its_scopes_are_mapped_to(verifier):
    identity = verifier.machines.identify(machine_token(scope="tidegate.read openid tidegate.run"))
    assert (identity.kind, identity.name) == ("machine", "machine:rvs")
    assert identity.permissions == {Permission.SESSIONS_READ, Permission.SESSIONS_RUN}
    assert not identity.is_person
    assert identity.until == NOW + timedelta(seconds=330)  # for its sockets, which no one asks for a token again


def test_scopes_may_come_as_a_list_under_another_claim():
    verifier = Verifier(oidc_machine_scope_claim="roles")
    assert verifier.machines.identify(machine_token(roles=["tidegate.read"])).permissions == {Permission.SESSIONS_READ}
    assert verifier.refused(machine_token()) == "scope"


@pytest.mark.parametrize(
    "scope", ["", ..., "openid", "Tidegate.read", {"tidegate.read": 1}, [["tidegate.read"]], 7], ids=str
)
def test_a_token_without_a_mapped_scope_opens_nothing(verifier, scope):
    assert verifier.refused(machine_token(scope=scope)) == "scope"


def test_no_mapping_gives_a_machine_what_only_people_may():
    everything = {"all": frozenset(Permission)}
    assert Permission.GATE_ACKNOWLEDGE not in permissions_of("all", everything)
    assert Permission.USERS_MANAGE not in permissions_of("all", everything)


def test_the_machine_is_named_by_its_client_wherever_the_provider_writes_it(verifier):
    assert verifier.machines.identify(machine_token(client_id=..., azp="planning")).name == "machine:planning"
    for client in (..., "", 7, " ", "x" * 73, "a\nb"):
        assert verifier.refused(machine_token(client_id=client)) == "claims"


def test_a_person_s_token_opens_nothing_as_a_bearer(verifier):
    assert verifier.refused(signed(person_claims())) == "type"
    assert verifier.refused(signed(person_claims(aud=AUDIENCE), typ="at+jwt")) == "type"
    assert verifier.refused(signed(machine_claims(aud=CLIENT), typ="at+jwt")) == "audience"


def test_a_token_ends_when_it_states_whatever_is_known_of_the_provider(verifier):
    token = machine_token()
    verifier.now = NOW + timedelta(seconds=329)
    assert verifier.machines.identify(token) is not None
    verifier.now = NOW + timedelta(seconds=330)
    assert verifier.refused(token) == "expired"


def test_tokens_are_judged_while_the_provider_is_down_until_its_keys_are_too_old(verifier):
    token = machine_token(exp=NOW_S + 80_000)
    verifier.source.is_down = True
    verifier.clock.advance_ns(3600 * NS_PER_S)
    verifier.provider.refresh()
    assert verifier.machines.identify(token) is not None
    verifier.clock.advance_ns(1)
    assert verifier.refused(token) == "unknown_key"


def test_no_access_before_the_provider_has_answered_once():
    verifier = Verifier()
    fresh = Provider(issuer=ISSUER, client=verifier.source, clock=verifier.clock, refresh_s=300.0, max_age_s=3600.0)
    verifier.machines._provider = fresh
    assert verifier.refused(machine_token()) == "unknown_key"


def test_verification_makes_no_request_and_an_unknown_key_only_triggers_a_renewal(verifier):
    asked = verifier.source.asked

    def fail(_address):
        raise AssertionError("the guard waited for the network")

    verifier.source.get_json = fail
    assert verifier.machines.identify(machine_token()) is not None
    token = signed(machine_claims(), key=OTHER_KEY, typ="at+jwt")
    assert verifier.machines.identify(token) is None
    assert verifier.source.asked == asked
    assert verifier.provider.due_s() == MIN_INTERVAL_S  # no longer the 300 s of a quiet day


def test_a_rotated_key_lets_the_machine_in_after_the_next_renewal_and_the_old_key_out(verifier):
    old, new = machine_token(), signed(machine_claims(), key=OTHER_KEY, typ="at+jwt")
    verifier.source.documents[f"{ISSUER}/jwks"] = published(OTHER_KEY)
    assert verifier.machines.identify(new) is None
    verifier.provider.refresh()
    assert verifier.machines.identify(new) is not None
    assert verifier.refused(old) == "unknown_key"


def test_bad_tokens_that_name_known_keys_ask_for_nothing(verifier):
    for token in ("", "x.y.z", machine_token(exp=1), machine_token(aud="x")):
        assert verifier.machines.identify(token) is None
    assert verifier.provider.due_s() == 300.0


def test_a_renewal_that_fails_is_reported_as_unavailable_and_nothing_else(verifier):
    verifier.source.is_down = True
    with pytest.raises(OidcUnavailableError):
        verifier.source.get_json("x")
    assert not verifier.provider.refresh()
