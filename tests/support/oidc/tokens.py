"""Tokens by construction: honest ones of a provider, and every way in which one may lie."""

import base64
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from joserfc import jwt
from joserfc.jwk import ECKey, KeySet, RSAKey

from service.access.oidc.tokens import ExpectedClaims

ISSUER = "https://provider.example"
CLIENT = "tidegate"
AUDIENCE = "tidegate-api"
NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
NOW_S = int(NOW.timestamp())
NONCE = "n-0123456789"

KEY = RSAKey.generate_key(2048, {"kid": "first", "use": "sig", "alg": "RS256"})
OTHER_KEY = RSAKey.generate_key(2048, {"kid": "second", "use": "sig", "alg": "RS256"})
CURVE_KEY = ECKey.generate_key("P-256", {"kid": "curve"})


def published(*keys: RSAKey | ECKey) -> dict[str, Any]:
    return {"keys": [key.as_dict(private=False) for key in keys]}


KEYS = KeySet([KEY, CURVE_KEY])


def expected(audience: str = CLIENT, max_skew_s: int = 30) -> ExpectedClaims:
    return ExpectedClaims(issuer=ISSUER, audience=audience, now=NOW, max_skew_s=max_skew_s)


def person_claims(**changes: Any) -> dict[str, Any]:
    claims = {
        "iss": ISSUER,
        "sub": "u-1",
        "aud": CLIENT,
        "iat": NOW_S,
        "exp": NOW_S + 300,
        "nonce": NONCE,
        "name": "Jane Doe",
        "groups": ["radiotherapy"],
    }
    return _changed(claims, changes)


def machine_claims(**changes: Any) -> dict[str, Any]:
    claims = {
        "iss": ISSUER,
        "sub": "rvs",
        "client_id": "rvs",
        "aud": AUDIENCE,
        "iat": NOW_S,
        "exp": NOW_S + 300,
        "scope": "tidegate.read",
    }
    return _changed(claims, changes)


def _changed(claims: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in {**claims, **changes}.items() if value is not ...}


def signed(claims: Mapping[str, Any], *, key: RSAKey | ECKey = KEY, **header: Any) -> str:
    algorithm = "ES256" if isinstance(key, ECKey) else "RS256"
    full = {"alg": algorithm, "kid": key.kid, **header}
    full = {name: value for name, value in full.items() if value is not ...}
    return jwt.encode(full, dict(claims), key, algorithms=[full["alg"]])


def machine_token(**changes: Any) -> str:
    return signed(machine_claims(**changes), typ="at+jwt")


def part(value: object) -> str:
    raw = value if isinstance(value, bytes) else json.dumps(value).encode()
    return base64.urlsafe_b64encode(raw).rstrip(b"=").decode()
