"""Validation of signed tokens (JWT): signature, issuer, audience, times. Pure functions of token, keys and time.

A token's header is not trusted: the algorithm must be one of a fixed list of asymmetric ones, the key one that the
provider publishes, and keys or URLs in the header are ignored.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from authlib.oidc.core import CodeIDToken
from joserfc import jws, jwt
from joserfc.errors import (
    BadSignatureError,
    ClaimError,
    ExpiredTokenError,
    JoseError,
    MissingClaimError,
)
from joserfc.jwk import ECKey, KeySet, RSAKey
from joserfc.util import base64_to_int

from service.access.oidc.refusals import OidcReason, OidcRefusedError

KEY_OF = {"RS": "RSA", "PS": "RSA", "ES": "EC"}
ALGORITHMS = tuple(f"{family}{size}" for family in KEY_OF for size in (256, 384, 512))
MAX_TOKEN_CHARACTERS = 16_384
MAX_HEADER_BYTES = 2_048
MAX_SUBJECT_CHARACTERS = 255
MAX_KEYS = 64
MIN_RSA_BITS = 2_048
MAX_RSA_BITS = 8_192
MAX_TOKEN_LIFE_S = 86_400
"""Longest accepted life of a machine's token [s], since it cannot be revoked earlier."""

_REASON_OF_CLAIM = {
    "iss": OidcReason.ISSUER,
    "aud": OidcReason.AUDIENCE,
    "azp": OidcReason.AUDIENCE,
    "nonce": OidcReason.NONCE,
    "nbf": OidcReason.NOT_YET_VALID,
    "iat": OidcReason.NOT_YET_VALID,
}
Claims = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedClaims:
    """What a token is validated against: issuer, audience, current time and tolerated clock skew [s]."""

    issuer: str
    audience: str
    now: datetime
    max_skew_s: int

    @property
    def now_s(self) -> int:
        """The current time in whole seconds since 1970 (NumericDate)."""
        return int(self.now.timestamp())


class _Registry(jws.JWSRegistry):
    max_header_length = MAX_HEADER_BYTES
    max_payload_length = MAX_TOKEN_CHARACTERS


_REGISTRY = _Registry(algorithms=ALGORITHMS, strict_check_header=False)


def keys_from(document: Mapping[str, Any]) -> KeySet:
    """Return the usable signing keys of a published key set; other entries are ignored.

    Raises
    ------
    OidcRefusedError
        No usable key is left, or there are more than `MAX_KEYS`.
    """
    found = document.get("keys")
    if not isinstance(found, list) or len(found) > MAX_KEYS:
        raise OidcRefusedError(OidcReason.MALFORMED, f"the provider's keys are not a list of at most {MAX_KEYS}")
    keys = [key for key in map(_signing_key, found) if key is not None]
    if not keys:
        raise OidcRefusedError(OidcReason.UNKNOWN_KEY, "the provider publishes no key that signs by RSA or EC")
    return KeySet(keys)  # type: ignore[arg-type]


def _signing_key(one: object) -> RSAKey | ECKey | None:
    if not isinstance(one, dict) or one.get("use", "sig") != "sig" or not isinstance(one.get("kid", ""), str):
        return None
    public = {name: one[name] for name in ("kty", "kid", "use", "alg", "n", "e", "crv", "x", "y") if name in one}
    try:
        if one.get("kty") == "RSA":
            is_strong = MIN_RSA_BITS <= base64_to_int(one["n"]).bit_length() <= MAX_RSA_BITS
            return RSAKey.import_key(public) if is_strong else None
        return ECKey.import_key(public) if one.get("kty") == "EC" else None
    except (JoseError, ValueError, TypeError, KeyError, AttributeError):
        return None


def read_signed(text: str, keys: KeySet) -> jwt.Token:
    """Decode a token and verify its signature; the claims are not validated.

    Raises
    ------
    OidcRefusedError
        No key and allowed algorithm verify it. ``unknown_key`` is also the result of a key rotation.
    """
    if len(text) > MAX_TOKEN_CHARACTERS or text.count(".") != 2:
        raise OidcRefusedError(OidcReason.MALFORMED, f"not a signed token of at most {MAX_TOKEN_CHARACTERS} characters")
    try:
        header = jws.extract_compact(text.encode("ascii"), registry=_REGISTRY).headers()
        key = _key_for(header, keys)
        return jwt.decode(text, key, algorithms=ALGORITHMS, registry=_REGISTRY)
    except BadSignatureError as error:
        raise OidcRefusedError(OidcReason.SIGNATURE) from error
    except (JoseError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise OidcRefusedError(OidcReason.MALFORMED) from error


def _key_for(header: Mapping[str, Any], keys: KeySet) -> RSAKey | ECKey:
    algorithm, kid = header.get("alg"), header.get("kid")
    if algorithm not in ALGORITHMS or "crit" in header:
        raise OidcRefusedError(OidcReason.ALGORITHM, f"only {', '.join(ALGORITHMS)}, and nothing critical beside")
    matching = [
        key
        for key in keys
        if isinstance(key, RSAKey | ECKey)
        and key.key_type == KEY_OF[algorithm[:2]]
        and key.get("alg", algorithm) == algorithm
        and (kid is None or key.kid == kid)
    ]
    if len(matching) != 1:
        raise OidcRefusedError(OidcReason.UNKNOWN_KEY)
    return matching[0]


def check_id_token(text: str, keys: KeySet, expected: ExpectedClaims, *, nonce: str, access_token: str) -> Claims:
    """Validate an ID token (OpenID Connect Core 1.0, section 3.1.3.7); raise OidcRefusedError if it fails."""
    token = read_signed(text, keys)
    claims = CodeIDToken(
        token.claims,
        token.header,
        options={"iss": {"essential": True, "value": expected.issuer}, "aud": _essential(expected.audience)},
        params={"nonce": nonce, "client_id": expected.audience, "access_token": access_token},
    )
    _validate(claims, expected)
    return dict(token.claims)


def check_machine_token(text: str, keys: KeySet, expected: ExpectedClaims, *, types: tuple[str, ...]) -> Claims:
    """Validate a machine's access token (RFC 9068, section 4); raise OidcRefusedError if it fails."""
    token = read_signed(text, keys)
    kind = token.header.get("typ", "")
    if not isinstance(kind, str) or kind.lower().removeprefix("application/") not in types:
        raise OidcRefusedError(OidcReason.TYPE, f"its typ must be {' or '.join(types)}")
    if "nonce" in token.claims or "at_hash" in token.claims:
        raise OidcRefusedError(OidcReason.TYPE, "it is an ID token, not an access token")
    _validate(_machine_claims(token, expected), expected)
    if token.claims["exp"] - token.claims["iat"] > MAX_TOKEN_LIFE_S:
        raise OidcRefusedError(OidcReason.TOO_LONG_LIVED, f"made to last more than {MAX_TOKEN_LIFE_S} s")
    return dict(token.claims)


def _machine_claims(token: jwt.Token, expected: ExpectedClaims) -> CodeIDToken:
    return CodeIDToken(
        token.claims,
        token.header,
        options={"iss": {"essential": True, "value": expected.issuer}, "aud": _essential(expected.audience)},
    )


def _essential(value: str) -> dict[str, object]:
    return {"essential": True, "value": value}


def _validate(claims: CodeIDToken, expected: ExpectedClaims) -> None:
    subject = claims.get("sub")
    if not isinstance(subject, str) or not 0 < len(subject) <= MAX_SUBJECT_CHARACTERS or not subject.isprintable():
        raise OidcRefusedError(OidcReason.CLAIMS, f"sub must be 1 to {MAX_SUBJECT_CHARACTERS} printable characters")
    try:
        claims.validate(now=expected.now_s, leeway=expected.max_skew_s)
    except ExpiredTokenError as error:
        raise OidcRefusedError(OidcReason.EXPIRED) from error
    except MissingClaimError as error:
        reason = OidcReason.CLAIMS if error.claim == "iat" else _REASON_OF_CLAIM.get(error.claim, OidcReason.CLAIMS)
        raise OidcRefusedError(reason, f"{error.claim} is missing") from error
    except ClaimError as error:
        reason = _REASON_OF_CLAIM.get(error.claim, OidcReason.CLAIMS)
        raise OidcRefusedError(reason, f"{error.claim} is not what was expected") from error
    except (JoseError, ValueError, TypeError) as error:
        raise OidcRefusedError(OidcReason.CLAIMS) from error
