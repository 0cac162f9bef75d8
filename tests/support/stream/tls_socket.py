"""A WebSocket client over TLS that reads and writes in one thread.

The synchronous client of `websockets` reads in a thread while another writes, on one connection of OpenSSL, which is
not made for that: now and then a request is lost, and the service rightly answers 408 to its silence.
"""

import asyncio
import ssl
from collections.abc import Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

from websockets.asyncio.client import connect

from tests.support.waiting import PATIENCE_S

Result = TypeVar("Result")


class TlsSocket:
    """A connection; it reads only while `recv` waits.

    All of it runs in one thread of its own: the test's may hold Playwright's running event loop.
    """

    def __init__(self, url: str, headers: Mapping[str, str], trusted: ssl.SSLContext) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = ThreadPoolExecutor(1)
        self._url, self._headers, self._trusted = url, headers, trusted

    def __enter__(self) -> "TlsSocket":
        """Connect."""
        self._socket = self._run(self._connected())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the connection."""
        self._run(self._socket.close())
        self._thread.submit(self._loop.close).result()
        self._thread.shutdown()

    def _run(self, coroutine: Coroutine[object, object, Result]) -> Result:
        return self._thread.submit(self._loop.run_until_complete, coroutine).result()

    async def _connected(self):
        return await connect(
            self._url,
            additional_headers=self._headers,
            ssl=self._trusted,
            max_queue=None,
            open_timeout=PATIENCE_S,
        )

    def recv(self, timeout: float) -> str | bytes:
        """Return the next message; raise TimeoutError where none comes in time [s]."""
        return self._run(asyncio.wait_for(self._socket.recv(), timeout))
