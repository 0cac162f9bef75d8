"""Tokens that are believed, and all those that are not: each lie is one change to an honest token."""

import hmac
import math
from typing import Any

import pytest
from joserfc.jwk import ECKey, KeySet, OctKey, RSAKey

from service.access.oidc.refusals import OidcReason, OidcRefusedError
from service.access.oidc.tokens import (
    MAX_TOKEN_CHARACTERS,
    check_id_token,
    check_machine_token,
    keys_from,
    read_signed,
)
from tests.support.oidc.tokens import (
    AUDIENCE,
    CLIENT,
    CURVE_KEY,
    KEY,
    KEYS,
    NONCE,
    NOW_S,
    OTHER_KEY,
    expected,
    machine_claims,
    machine_token,
    part,
    person_claims,
    published,
    signed,
)


def person(text: str, keys: KeySet = KEYS, access_token: str = "opaque") -> Any:
    return check_id_token(text, keys, expected(), nonce=NONCE, access_token=access_token)


def machine(text: str) -> Any:
    return check_machine_token(text, KEYS, expected(AUDIENCE), types=("at+jwt",))


def refused(call: Any, *arguments: Any) -> OidcReason:
    with pytest.raises(OidcRefusedError) as caught:
        call(*arguments)
    return caught.value.reason


@pytest.mark.parametrize("key", [KEY, CURVE_KEY], ids=["RS256", "ES256"])
def test_an_honest_token_of_a_person_is_believed(key):
    assert person(signed(person_claims(), key=key))["sub"] == "u-1"


def test_an_honest_token_of_a_machine_is_believed():
    assert machine(machine_token())["client_id"] == "rvs"
    assert machine(signed(machine_claims(), typ="application/AT+JWT"))["client_id"] == "rvs"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"iss": "https://provider.example/"}, "issuer"),
        ({"iss": "https://other.example"}, "issuer"),
        ({"iss": ...}, "issuer"),
        ({"aud": "another-client"}, "audience"),
        ({"aud": ["another-client"]}, "audience"),
        ({"aud": [CLIENT, "another-client"]}, "audience"),  # no one says which of the two asked
        ({"aud": [CLIENT, "another-client"], "azp": "another-client"}, "audience"),
        ({"azp": "another-client"}, "audience"),
        ({"aud": []}, "audience"),
        ({"aud": {CLIENT: 1}}, "audience"),
        ({"nonce": "another"}, "nonce"),
        ({"nonce": ...}, "nonce"),
        ({"nonce": [NONCE]}, "nonce"),
        ({"exp": NOW_S - 31}, "expired"),
        ({"exp": NOW_S - 30}, "expired"),
        ({"exp": ...}, "claims"),
        ({"exp": math.nan}, "claims"),
        ({"exp": math.inf}, "claims"),
        ({"exp": "tomorrow"}, "claims"),
        ({"exp": True}, "claims"),
        ({"nbf": NOW_S + 31}, "not_yet_valid"),
        ({"iat": NOW_S + 31}, "not_yet_valid"),
        ({"iat": ...}, "claims"),
        ({"sub": ...}, "claims"),
        ({"sub": ""}, "claims"),
        ({"sub": 7}, "claims"),
        ({"sub": "u" * 256}, "claims"),
        ({"sub": "u\n1"}, "claims"),
        ({"at_hash": "bm90IHRoZSBoYXNo"}, "claims"),
        ({"at_hash": 7}, "claims"),
    ],
    ids=str,
)
def test_a_person_s_token_with_one_claim_that_is_not_ours_is_refused(changes, reason):
    assert refused(person, signed(person_claims(**changes))) == reason


@pytest.mark.parametrize("changes", [{"exp": NOW_S - 29}, {"nbf": NOW_S + 30}, {"iat": NOW_S + 30}], ids=str)
def test_clocks_may_be_apart_by_what_the_site_allows(changes):
    assert person(signed(person_claims(**changes)))["sub"] == "u-1"


def test_two_audiences_are_believed_where_it_states_that_we_asked():
    assert person(signed(person_claims(aud=["a", CLIENT], azp=CLIENT)))["sub"] == "u-1"


def test_the_hash_of_the_access_token_is_compared_where_there_is_one():
    # Made by the formula of OpenID Connect Core 1.0, 3.1.3.6: left half of SHA-256, base64url.
    import base64
    import hashlib

    half = base64.urlsafe_b64encode(hashlib.sha256(b"the token").digest()[:16]).rstrip(b"=").decode()
    text = signed(person_claims(at_hash=half))
    assert person(text, access_token="the token")["sub"] == "u-1"
    assert refused(lambda: person(text, access_token="another token")) == "claims"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"aud": CLIENT}, "audience"),  # a token for the page is none for the API
        ({"iss": "https://other.example"}, "issuer"),
        ({"exp": NOW_S - 31}, "expired"),
        ({"nbf": NOW_S + 31}, "not_yet_valid"),
        ({"exp": NOW_S + 86_401}, "too_long_lived"),
        ({"nonce": NONCE}, "type"),
        ({"at_hash": "x"}, "type"),
    ],
    ids=str,
)
def test_a_machine_s_token_with_one_claim_that_is_not_ours_is_refused(changes, reason):
    assert refused(machine, machine_token(**changes)) == reason


@pytest.mark.parametrize("kind", ["JWT", "id+jwt", "", ..., 7, ["at+jwt"]], ids=str)
def test_a_machine_s_token_of_another_type_is_refused(kind):
    assert refused(machine, _raw({"alg": "RS256", "kid": "first", "typ": kind}, machine_claims())) in {
        "type",
        "malformed",
    }


def _raw(header: dict[str, Any], claims: dict[str, Any]) -> str:
    """Sign whatever header is given, also what the library would not write."""
    from cryptography.hazmat.primitives.asymmetric.padding import PKCS1v15
    from cryptography.hazmat.primitives.hashes import SHA256

    reported = {name: value for name, value in header.items() if value is not ...}
    content = f"{part(reported)}.{part(claims)}"
    return f"{content}.{part(KEY.private_key.sign(content.encode(), PKCS1v15(), SHA256()))}"


def test_no_signature_at_all_is_refused():
    for name in ("none", "None", "NONE", ""):
        assert refused(person, f"{part({'alg': name, 'kid': 'first'})}.{part(person_claims())}.") == "algorithm"


def test_a_public_key_used_as_a_shared_secret_is_refused():
    for secret in (KEY.as_pem(private=False), KEY.as_der(private=False)):
        content = f"{part({'alg': 'HS256', 'kid': 'first'})}.{part(person_claims())}"
        forged = f"{content}.{part(hmac.digest(secret, content.encode(), 'sha256'))}"
        assert refused(person, forged) == "algorithm"


def test_a_key_that_the_token_brings_along_is_not_looked_at():
    mine = RSAKey.generate_key(2048, {"kid": "first"})
    for header in (
        {"jwk": mine.as_dict(private=False)},
        {"jku": "https://evil.example/jwks"},
        {"x5u": "https://e.example"},
    ):
        text = _raw({"alg": "RS256", "kid": "first", **header}, person_claims())
        head, claims, _ = text.split(".")
        forged = signed(person_claims(), key=mine).split(".")[2]
        assert refused(person, f"{head}.{claims}.{forged}") == "signature"


def test_a_token_signed_by_another_key_of_that_name_is_refused():
    mine = RSAKey.generate_key(2048, {"kid": "first"})
    assert refused(person, signed(person_claims(), key=mine)) == "signature"


def test_a_key_that_is_not_published_is_distinguished_since_that_is_what_a_rotation_looks_like():
    assert refused(person, signed(person_claims(), key=OTHER_KEY)) == "unknown_key"


def test_a_key_is_only_used_for_what_it_states_it_is_for():
    assert refused(person, _raw({"alg": "RS512", "kid": "first"}, person_claims())) == "unknown_key"
    assert refused(person, _raw({"alg": "ES256", "kid": "first"}, person_claims())) == "unknown_key"


def test_a_token_that_names_no_key_is_believed_only_where_one_key_fits():
    assert person(signed(person_claims(), kid=...))["sub"] == "u-1"
    two = KeySet([KEY, OTHER_KEY])
    assert refused(person, signed(person_claims(), kid=...), two) == "unknown_key"


def test_what_a_token_calls_critical_and_we_do_not_know_is_refused():
    assert refused(person, _raw({"alg": "RS256", "kid": "first", "crit": ["b64"], "b64": False}, {})) == "algorithm"


def test_a_claim_changed_after_signing_is_refused():
    head, _, signature = signed(person_claims()).split(".")
    assert refused(person, f"{head}.{part(person_claims(groups=['administrators']))}.{signature}") == "signature"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "..",
        "a.b.c",
        "é.é.é",
        "a.b.c.d.e",
        f"{part([1, 2])}.{part({})}.{part(b'x')}",
        f"{part(7)}.{part({})}.{part(b'x')}",
        f"{part(b'[' * 1500)}.{part({})}.{part(b'x')}",
        f"{part({'alg': ['RS256']})}.{part({})}.{part(b'x')}",
        f"{part({'alg': 'RS256', 'kid': {}})}.{part({})}.{part(b'x')}",
        f"{part({'alg': 'RS256', 'pad': 'x' * 3000})}.{part({})}.{part(b'x')}",
        _raw({"alg": "RS256", "kid": "first"}, []),  # type: ignore[arg-type]
        "x" * MAX_TOKEN_CHARACTERS + "..",
    ],
    ids=lambda text: text[:24],
)
def test_what_is_no_token_is_refused_and_raises_nothing_else(text):
    assert refused(read_signed, text, KEYS) in {"malformed", "algorithm", "unknown_key"}


def test_a_signed_token_that_is_nested_without_end_is_refused():
    deep = "[" * 6000 + "]" * 6000
    content = f"{part({'alg': 'RS256', 'kid': 'first'})}.{part(deep.encode())}"
    from cryptography.hazmat.primitives.asymmetric.padding import PKCS1v15
    from cryptography.hazmat.primitives.hashes import SHA256

    signature = part(KEY.private_key.sign(content.encode(), PKCS1v15(), SHA256()))
    assert refused(read_signed, f"{content}.{signature}", KEYS) == "malformed"


def test_only_keys_that_sign_by_a_private_half_are_taken_and_weak_or_odd_ones_are_left_out():
    shared = OctKey.generate_key(256, {"kid": "shared"}).as_dict(private=True)
    weak = {**OTHER_KEY.as_dict(private=False), "n": part(b"\xff" * 128), "kid": "weak"}
    cipher = {**OTHER_KEY.as_dict(private=False), "use": "enc"}
    odd: list[Any] = [
        7,
        None,
        {},
        {"kty": "RSA"},
        {"kty": "RSA", "n": 5, "e": []},
        {"kty": "EC", "crv": "no"},
        {"kid": []},
    ]
    found = keys_from({"keys": [shared, weak, cipher, *odd, *published(KEY, CURVE_KEY)["keys"]]})
    assert [key.kid for key in found] == ["first", "curve"]


@pytest.mark.parametrize("document", [{}, {"keys": {}}, {"keys": []}, {"keys": [{}]}, {"keys": [{}] * 65}], ids=str)
def test_a_set_without_a_usable_key_is_refused(document):
    refused(keys_from, document)


def test_a_private_half_that_a_provider_publishes_by_mistake_is_not_kept():
    found = keys_from({"keys": [KEY.as_dict(private=True)]})
    assert not any(key.is_private for key in found if isinstance(key, RSAKey | ECKey))
