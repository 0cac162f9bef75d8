"""Who is connected: counted in all and by address, looked at once a second, and sent away in the order of who waits.

Places are bounded, and a newcomer gets one all the same: whoever has been waited for longest goes for it, of the
address that has most; a caller whom the guard knows goes only where no stranger does. So thousands who only keep
connections open, or begin requests and do not end them, or leave answers unread, keep no call to hold the beam out.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Callable, Sequence
from typing import Protocol

from service.access.addresses import plain
from service.doors.limits import DoorLimits
from service.doors.refusals import RefusalCount

LOOK_EVERY_S = 1.0
UNKNOWN = "unknown"


class Visitor(Protocol):
    """One connection, as the book sees it."""

    @property
    def waits(self) -> bool:
        """Whether it is the client's turn, and nothing of its own is worked on: this one may be closed for another."""

    @property
    def is_known(self) -> bool:
        """Whether the guard knows whose request is under way."""

    def look(self, now_s: float) -> str | None:
        """End it if it is overdue; returns how, for the count."""

    def leave(self) -> None:
        """Close at once."""


class VisitorBook:
    """All connections of a server; for its event loop's thread alone."""

    def __init__(self, limits: DoorLimits, *, trusted_proxies: Sequence[str] = ()) -> None:
        self.limits = limits
        self._trusted = [ipaddress.ip_network(text) for text in trusted_proxies]
        self._by_address: dict[str, dict[object, Visitor]] = {}
        self._address_of: dict[object, str] = {}
        self._next_look: asyncio.TimerHandle | None = None
        self.refusals = RefusalCount(_loop_time)

    def __len__(self) -> int:
        """How many are connected."""
        return len(self._address_of)

    def enter(self, key: object, visitor: Visitor, address: str | None) -> bool:
        """Give a newcomer a place; False where for every connection there is something is worked on."""
        where = self._where(address)
        if not self._makes_room(where):
            self.refusals.add("connections_full")
            return False
        self._by_address.setdefault(where, {})[key] = visitor
        self._address_of[key] = where
        self._look_again()
        return True

    def becomes(self, key: object, visitor: Visitor) -> None:
        """Let another protocol take a connection over."""
        where = self._address_of.get(key)
        if where is not None:
            self._by_address[where][key] = visitor

    def stirs(self, key: object) -> None:
        """Note that a connection's turn begins: of those who are waited for it is the last to go."""
        where = self._address_of.get(key)
        if where is not None:
            self._by_address[where][key] = self._by_address[where].pop(key)

    def leave(self, key: object) -> None:
        """Forget a connection that is closed; safe to call twice."""
        where = self._address_of.pop(key, None)
        if where is not None:
            self._by_address[where].pop(key, None)
            if not self._by_address[where]:
                del self._by_address[where]

    def _where(self, address: str | None) -> str:
        """Return under which address a connection is counted."""
        return UNKNOWN if address is None else plain(address)

    def _makes_room(self, where: str) -> bool:
        ours = self._by_address.get(where, {})
        if len(ours) >= self.limits.max_connections_per_address and not self._is_proxy(where):
            return self._send_one_away(where)
        if len(self) >= self.limits.max_connections:
            # Addresses in the order of how many places they take: there are few that take many.
            crowded = sorted(self._by_address, key=lambda one: len(self._by_address[one]), reverse=True)
            return self._send_one_away(*crowded)
        return True

    def _send_one_away(self, *addresses: str) -> bool:
        """Close who was waited for longest, of the first address that has one; those who are known last."""
        for is_known in (False, True):
            for where in addresses:
                for key, visitor in self._by_address[where].items():
                    if visitor.waits and visitor.is_known is is_known:
                        self.refusals.add("closed_for_another")
                        self.leave(key)
                        visitor.leave()
                        return True
        return False

    def _is_proxy(self, where: str) -> bool:
        return where != UNKNOWN and any(ipaddress.ip_address(where) in network for network in self._trusted)

    def _look_again(self) -> None:
        if self._next_look is None:
            self._next_look = asyncio.get_running_loop().call_later(LOOK_EVERY_S, self._look)

    def _look(self) -> None:
        self._next_look = None
        now_s = _loop_time()
        for visitors in list(self._by_address.values()):
            for visitor in list(visitors.values()):
                how = visitor.look(now_s)
                if how is not None:
                    self.refusals.add(how)
        self.refusals.tell()
        if self._address_of:
            self._look_again()


def _loop_time() -> float:
    return asyncio.get_running_loop().time()


MakeProtocol = Callable[..., asyncio.Protocol]
