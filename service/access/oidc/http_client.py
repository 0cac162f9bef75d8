"""HTTP calls to the provider: bounded in time and size, certificates verified, no redirects, no proxy.

All calls block: never call them from the event loop or from a request that is answered from memory.
"""

import json
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from urllib.parse import quote_plus

import httpx2
from authlib.integrations.base_client import OAuthError
from authlib.integrations.httpx_client import OAuth2Client
from authlib.oauth2.rfc6749.parameters import prepare_grant_uri
from authlib.oauth2.rfc7636 import create_s256_code_challenge

from service.access.oidc.refusals import OidcReason, OidcRefusedError, OidcUnavailableError

MAX_ANSWER_BYTES = 512 * 1024
WHOLE_FACTOR = 2.0
"""A whole call takes at most this many times the time-out for a single read."""
MAX_CALLS = 8
_CALL_SLOTS = threading.BoundedSemaphore(MAX_CALLS)


def _within(seconds: float, work: Callable[[], httpx2.Response]) -> httpx2.Response:
    """Run a call in a thread that is abandoned after the time-out: response headers may arrive one byte at a time."""
    if not _CALL_SLOTS.acquire(blocking=False):
        msg = "too many calls to the provider hang"
        raise OidcUnavailableError(msg)
    response: Future[httpx2.Response] = Future()

    def call() -> None:
        try:
            response.set_result(work())
        except (httpx2.HTTPError, httpx2.InvalidURL, OSError, ValueError, RuntimeError) as error:
            response.set_exception(error)
        finally:
            _CALL_SLOTS.release()

    threading.Thread(target=call, name="oidc-call", daemon=True).start()
    try:
        return response.result(seconds)
    except TimeoutError as error:
        msg = "the provider's answer did not begin in time"
        raise OidcUnavailableError(msg) from error


class _Bounded(httpx2.SyncByteStream):
    """A response body; raises OidcUnavailableError beyond its size or time limit."""

    def __init__(self, inner: httpx2.SyncByteStream, until_s: float) -> None:
        self._inner = inner
        self._until_s = until_s

    def __iter__(self) -> Iterator[bytes]:
        read_bytes = 0
        for chunk in self._inner:
            read_bytes += len(chunk)
            if read_bytes > MAX_ANSWER_BYTES:
                msg = f"the provider answered with more than {MAX_ANSWER_BYTES} bytes"
                raise OidcUnavailableError(msg)
            if time.monotonic() > self._until_s:
                msg = "the provider's answer did not end in time"
                raise OidcUnavailableError(msg)
            yield chunk

    def close(self) -> None:
        self._inner.close()


class _BoundedTransport(httpx2.BaseTransport):
    def __init__(self, context: ssl.SSLContext, timeout_s: float) -> None:
        self._inner = httpx2.HTTPTransport(verify=context, trust_env=False)
        self._whole_s = timeout_s * WHOLE_FACTOR

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """Send a request and bound its response; compressed ones are refused: they may expand to any size."""
        until_s = time.monotonic() + self._whole_s
        request.headers["Accept-Encoding"] = "identity"
        answer = _within(self._whole_s, lambda: self._inner.handle_request(request))
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            answer.close()
            msg = "the provider compressed its answer although it was asked not to"
            raise OidcUnavailableError(msg)
        stream = answer.stream
        assert isinstance(stream, httpx2.SyncByteStream)
        return httpx2.Response(
            answer.status_code, headers=answer.headers, stream=_Bounded(stream, until_s), extensions=answer.extensions
        )

    def close(self) -> None:
        self._inner.close()


class ProviderClient:
    """HTTP client for the provider's documents and token endpoint; ``timeout_s`` [s] bounds each read."""

    def __init__(
        self,
        *,
        client_id: str = "",
        client_secret: str | None = None,
        timeout_s: float = 5.0,
        ca_file: Path | None = None,
    ) -> None:
        self._client_id = client_id
        self._client_secret = client_secret
        self._timeout_s = timeout_s
        self._context = ssl.create_default_context(cafile=ca_file)

    def get_json(self, address: str) -> Mapping[str, Any]:
        """Fetch a JSON object.

        Raises
        ------
        OidcUnavailableError
            It cannot be fetched, or is not a JSON object.
        """
        transport = _BoundedTransport(self._context, self._timeout_s)
        try:
            with httpx2.Client(transport=transport, timeout=self._timeout_s, trust_env=False) as client:
                answer = client.get(address, headers={"Accept": "application/json"})
                return _json_object(answer)
        except (httpx2.HTTPError, httpx2.InvalidURL, OSError) as error:
            msg = f"the provider cannot be reached ({type(error).__name__})"
            raise OidcUnavailableError(msg) from error

    def exchange(
        self, address: str, *, code: str, verifier: str, redirect_uri: str, accepts_basic: bool = True
    ) -> Mapping[str, Any]:
        """Exchange an authorisation code for tokens.

        Raises
        ------
        OidcRefusedError
            The provider refuses the code: used before, expired, or issued to another client or verifier.
        OidcUnavailableError
            It cannot be reached, or its response is not valid.
        """
        client_id, client_secret, method = self._client_id, self._client_secret, "none"
        if client_secret is not None and accepts_basic:
            # RFC 6749, 2.3.1: both are form-encoded before they go into a Basic header
            client_id, client_secret, method = quote_plus(client_id), quote_plus(client_secret), "client_secret_basic"
        elif client_secret is not None:
            method = "client_secret_post"
        client = OAuth2Client(
            client_id=client_id,
            client_secret=client_secret,
            token_endpoint_auth_method=method,
            transport=_BoundedTransport(self._context, self._timeout_s),
            timeout=self._timeout_s,
            trust_env=False,
            follow_redirects=False,
        )
        try:
            with client:
                token = client.fetch_token(
                    address,
                    grant_type="authorization_code",
                    code=code,
                    code_verifier=verifier,
                    redirect_uri=redirect_uri,
                )
        except OAuthError as error:
            raise OidcRefusedError(OidcReason.CODE, "the provider does not take the code") from error
        except (httpx2.HTTPError, OSError, ValueError, RecursionError) as error:
            msg = f"the provider did not answer as one does ({type(error).__name__})"
            raise OidcUnavailableError(msg) from error
        return dict(token)


def authorization_url(address: str, *, client_id: str, verifier: str, **parameters: str) -> str:
    """Return the URL of the authorisation request: code flow with PKCE (S256)."""
    return str(
        prepare_grant_uri(
            address,
            client_id=client_id,
            response_type="code",
            code_challenge=create_s256_code_challenge(verifier),
            code_challenge_method="S256",
            **parameters,
        )
    )


def _json_object(answer: httpx2.Response) -> Mapping[str, Any]:
    if answer.status_code != httpx2.codes.OK:
        msg = f"the provider answered {answer.status_code}"
        raise OidcUnavailableError(msg)
    try:
        found = json.loads(answer.content)
    except (ValueError, RecursionError) as error:
        msg = "the provider's answer is no JSON"
        raise OidcUnavailableError(msg) from error
    if not isinstance(found, dict):
        msg = "the provider's answer is no JSON object"
        raise OidcUnavailableError(msg)
    return found
