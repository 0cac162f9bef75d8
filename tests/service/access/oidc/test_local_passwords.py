"""Passwords while people log in at the provider: only of accounts for the day it is down, and only with a reason."""

from dataclasses import dataclass

import pytest

from service.access.oidc.service import LocalLogins
from service.core.errors import BoundError, LocalLoginRefusedError
from service.core.settings.oidc import OidcSettings
from tests.support.oidc.provider_server import Provider

REASON = "the provider is down since 7 o'clock"


@dataclass
class Account:
    is_break_glass: bool


@pytest.fixture
def local(oidc):
    return LocalLogins(settings=OidcSettings(**oidc(Provider(issuer="https://provider.example"))))


def test_without_a_provider_every_password_is_an_ordinary_one():
    local = LocalLogins(settings=OidcSettings())
    assert not local.check(Account(is_break_glass=False), None)
    assert not local.check(Account(is_break_glass=True), None)


def test_with_a_provider_for_machines_alone_people_keep_their_passwords(oidc):
    people = dict.fromkeys(("oidc_client_id", "oidc_redirect_uri", "oidc_group_roles", "oidc_client_secret_file"), ...)
    settings = OidcSettings(**oidc(Provider(issuer="https://provider.example"), **people))
    assert not LocalLogins(settings=settings).check(Account(is_break_glass=False), None)


def test_with_a_provider_other_accounts_are_refused(local):
    with pytest.raises(LocalLoginRefusedError, match="the hospital's log-in"):
        local.check(Account(is_break_glass=False), REASON)


def test_a_site_may_keep_its_other_accounts(oidc):
    settings = OidcSettings(**oidc(Provider(issuer="https://provider.example"), oidc_local_accounts="all"))
    local = LocalLogins(settings=settings)
    assert not local.check(Account(is_break_glass=False), None)
    assert local.check(Account(is_break_glass=True), REASON)


def test_a_break_glass_account_gets_in_and_it_is_reported_that_it_was_used(local):
    assert local.check(Account(is_break_glass=True), REASON)


@pytest.mark.parametrize("reason", [None, "", "because", "       because       ", "x" * 501, "line\nbreak here"])
def test_a_break_glass_account_has_to_say_why(local, reason):
    with pytest.raises(BoundError) as caught:
        local.check(Account(is_break_glass=True), reason)
    assert caught.value.field == "reason"
