"""The registry of connections: counted in total and by address, and checked for time limits once a second.

The number is bounded. When it is reached, a new connection replaces the one that the server has waited for longest, of
the address with the most connections; authenticated ones are replaced last. So clients that keep thousands of
connections open, send half requests or do not read their answers cannot block a call to hold the beam.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Callable, Sequence
from typing import Protocol

from service.access.request.addresses import plain
from service.core.settings.groups import ConnectionLimits
from service.web.connections.refusals import RefusalCount

CHECK_PERIOD_S = 1.0
UNKNOWN = "unknown"
MakeProtocol = Callable[..., asyncio.Protocol]


class Connection(Protocol):
    """A connection, as the registry uses it."""

    @property
    def waits(self) -> bool:
        """Whether the server waits for the client, so that the connection may be replaced."""

    @property
    def is_authenticated(self) -> bool:
        """Whether the guard has authenticated the request in progress."""

    def check(self, now_s: float) -> str | None:
        """End the connection if a time limit is over; return the reason for the count, or None."""

    def abort(self) -> None:
        """Abort the connection."""


class ConnectionRegistry:
    """All connections of a server; for the event loop's thread only."""

    def __init__(self, limits: ConnectionLimits, *, trusted_proxies: Sequence[str] = ()) -> None:
        self.limits = limits
        self._trusted = [ipaddress.ip_network(text) for text in trusted_proxies]
        self._by_address: dict[str, dict[object, Connection]] = {}
        self._address_of: dict[object, str] = {}
        self._next_check: asyncio.TimerHandle | None = None
        self.refusals = RefusalCount(_loop_time)

    def __len__(self) -> int:
        """Return the number of connections."""
        return len(self._address_of)

    def add(self, key: object, connection: Connection, address: str | None) -> bool:
        """Register a new connection, replacing a waiting one if necessary; False if all are in use."""
        address_key = UNKNOWN if address is None else plain(address)
        if not self._make_room(address_key):
            self.refusals.add("connections_full")
            return False
        self._by_address.setdefault(address_key, {})[key] = connection
        self._address_of[key] = address_key
        self._schedule_check()
        return True

    def replace(self, key: object, connection: Connection) -> None:
        """Replace a connection by another protocol's object, for a WebSocket upgrade."""
        address_key = self._address_of.get(key)
        if address_key is not None:
            self._by_address[address_key][key] = connection

    def note_waiting(self, key: object) -> None:
        """Note that the server starts to wait for a connection: it becomes the last to be replaced."""
        address_key = self._address_of.get(key)
        if address_key is not None:
            self._by_address[address_key][key] = self._by_address[address_key].pop(key)

    def remove(self, key: object) -> None:
        """Remove a closed connection; may be called twice."""
        address_key = self._address_of.pop(key, None)
        if address_key is not None:
            self._by_address[address_key].pop(key, None)
            if not self._by_address[address_key]:
                del self._by_address[address_key]

    def _make_room(self, address_key: str) -> bool:
        ours = self._by_address.get(address_key, {})
        if len(ours) >= self.limits.max_connections_per_address and not self._is_proxy(address_key):
            return self._replace_one(address_key)
        if len(self) >= self.limits.max_connections:
            # Addresses by their number of connections, largest first.
            crowded = sorted(self._by_address, key=lambda one: len(self._by_address[one]), reverse=True)
            return self._replace_one(*crowded)
        return True

    def _replace_one(self, *addresses: str) -> bool:
        """Close the connection waited for longest, by address in the given order; authenticated ones last."""
        for is_authenticated in (False, True):
            for address_key in addresses:
                for key, connection in self._by_address[address_key].items():
                    if connection.waits and connection.is_authenticated is is_authenticated:
                        self.refusals.add("closed_for_another")
                        self.remove(key)
                        connection.abort()
                        return True
        return False

    def _is_proxy(self, address_key: str) -> bool:
        return address_key != UNKNOWN and any(ipaddress.ip_address(address_key) in network for network in self._trusted)

    def _schedule_check(self, in_s: float = CHECK_PERIOD_S) -> None:
        if self._next_check is None:
            self._next_check = asyncio.get_running_loop().call_later(in_s, self._check_all)

    def _check_all(self) -> None:
        now_s = _loop_time()
        late_s = now_s - self._next_check.when() if self._next_check else 0.0
        self._next_check = None
        if late_s > CHECK_PERIOD_S:  # the server stood still, perhaps its clients too: they get that time as well
            self._schedule_check(min(late_s, self.limits.header_s))
            return
        for connections in list(self._by_address.values()):
            for connection in list(connections.values()):
                how = connection.check(now_s)
                if how is not None:
                    self.refusals.add(how)
        self.refusals.log_counts()
        if self._address_of:
            self._schedule_check()


def _loop_time() -> float:
    return asyncio.get_running_loop().time()
