"""The provider as it is known: from memory, renewed by a thread of its own, kept through an outage, never hammered."""

import threading

import pytest

from engine.core.clock import NS_PER_S, ManualClock, MonotonicClock
from service.access.oidc.provider import MIN_INTERVAL_S, Provider, endpoints_from
from service.access.oidc.refusals import OidcUnavailableError
from tests.support.oidc.fake_source import FakeSource
from tests.support.oidc.provider_server import Provider as Described
from tests.support.oidc.tokens import ISSUER, OTHER_KEY, published


@pytest.fixture
def source():
    return FakeSource()


@pytest.fixture
def clock():
    return ManualClock(1_000 * NS_PER_S)


@pytest.fixture
def provider(source, clock):
    return Provider(issuer=ISSUER, client=source, clock=clock, refresh_s=300.0, max_age_s=3600.0)


def kids(provider: Provider) -> list[str | None]:
    known = provider.state()
    return [] if known is None else [key.kid for key in known.keys]


def test_nothing_is_known_before_the_provider_has_answered(provider):
    assert provider.state() is None
    assert not provider.is_reachable
    assert provider.due_s() == 0.0


def test_what_it_answered_is_known_and_renewed_in_time(provider, clock):
    assert provider.refresh()
    assert (kids(provider), provider.is_reachable, provider.due_s()) == (["first"], True, 300.0)
    clock.advance_ns(299 * NS_PER_S)
    assert provider.due_s() == 1.0


def test_keys_are_believed_through_an_outage_until_they_are_too_old(provider, source, clock):
    provider.refresh()
    source.is_down = True
    clock.advance_ns(3600 * NS_PER_S)
    assert not provider.refresh()
    assert (kids(provider), provider.is_reachable) == (["first"], False)
    clock.advance_ns(1)
    assert kids(provider) == []


def test_a_provider_that_is_down_is_asked_again_soon_but_not_sooner(provider, source, clock):
    source.is_down = True
    provider.refresh()
    assert provider.due_s() == MIN_INTERVAL_S
    clock.advance_ns(int(MIN_INTERVAL_S) * NS_PER_S)
    assert provider.due_s() == 0.0


def test_a_thousand_unknown_keys_ask_the_provider_once_in_thirty_seconds(provider, source, clock):
    provider.refresh()
    renewals = 1
    for _ in range(1_000):  # 100 s of ten tokens a second
        provider.request_refresh()
        if provider.due_s() == 0.0:
            provider.refresh()
            renewals += 1
        clock.advance_ns(NS_PER_S // 10)
    assert renewals == 1 + 3
    assert source.asked == 2 * renewals


def test_a_rotated_key_is_known_after_one_renewal_and_the_old_one_is_gone(provider, source):
    provider.refresh()
    source.documents[f"{ISSUER}/jwks"] = published(OTHER_KEY)
    provider.refresh()
    assert kids(provider) == ["second"]


def test_an_answer_that_cannot_be_used_leaves_what_is_known(provider, source):
    provider.refresh()
    source.documents[f"{ISSUER}/jwks"] = {"keys": []}
    assert not provider.refresh()
    assert kids(provider) == ["first"]


def test_the_thread_renews_by_itself_and_survives_unexpected_errors(source):
    provider = Provider(issuer=ISSUER, client=source, clock=MonotonicClock(), refresh_s=300.0, max_age_s=3600.0)
    odd = threading.Event()
    honest = source.get_json
    source.get_json = lambda address: odd.set() or {}[address]
    provider.start()
    assert odd.wait(5.0)
    source.get_json = honest
    with provider._changed:
        provider._tried_ns = None
        provider._changed.notify_all()
        assert provider._changed.wait_for(lambda: provider._known is not None, 5.0)
    provider.stop()
    provider._thread.join(5.0)
    assert not provider._thread.is_alive()


def test_only_calls_that_may_wait_wait_for_newer_keys(source, clock):
    provider = Provider(issuer=ISSUER, client=source, clock=clock, refresh_s=300.0, max_age_s=3600.0)
    provider.refresh()
    known = provider.state()
    assert provider.newer_than(known, 5.0) is None  # asked a moment ago: not within 30 s
    clock.advance_ns(int(MIN_INTERVAL_S) * NS_PER_S)
    source.documents[f"{ISSUER}/jwks"] = published(OTHER_KEY)
    renewing = threading.Thread(target=provider.refresh)
    renewing.start()
    newer = provider.newer_than(known, 5.0)
    renewing.join()
    assert newer is None or [key.kid for key in newer.keys] == ["second"]
    assert kids(provider) == ["second"]


@pytest.mark.parametrize(
    "changes",
    [
        {"issuer": f"{ISSUER}/"},
        {"issuer": None},
        {"jwks_uri": "http://provider.example/jwks"},
        {"jwks_uri": "http://127.0.0.1/jwks"},  # this machine, although the provider is elsewhere
        {"jwks_uri": "file:///etc/passwd"},
        {"jwks_uri": None},
        {"token_endpoint": "https://user@provider.example/token"},
        {"token_endpoint": "https://provider.example/token#x"},
        {"token_endpoint": 7},
        {"authorization_endpoint": "javascript:alert(1)"},
        {"authorization_endpoint": "https://provider.example/\r\nSet-Cookie: a=b"},
        {"authorization_endpoint": "//provider.example/authorize"},
        {"code_challenge_methods_supported": ["plain"]},
        {"code_challenge_methods_supported": "S256"},
    ],
    ids=str,
)
def test_a_description_that_leads_elsewhere_is_refused(changes):
    with pytest.raises(OidcUnavailableError):
        endpoints_from({**Described(issuer=ISSUER)._description(), **changes}, ISSUER)


def test_an_authorization_address_may_bring_a_query_of_its_own():
    document = {**Described(issuer=ISSUER)._description(), "authorization_endpoint": f"{ISSUER}/authorize?tenant=7"}
    assert endpoints_from(document, ISSUER).authorization.endswith("?tenant=7")
