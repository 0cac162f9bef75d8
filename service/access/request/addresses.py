"""The client address of a request: the TCP peer, or the address that a trusted proxy forwards."""

import ipaddress
from collections.abc import Sequence

from starlette.datastructures import Headers
from starlette.types import Scope

UNKNOWN = "unknown"
LOOPBACK = ("127.0.0.0/8", "::1")


class ClientAddresses:
    """Finds the client address of a request, by which failed log-ins are counted.

    Parameters
    ----------
    behind_proxy
        Whether ``X-Forwarded-For`` is read at all.
    trusted_proxies
        Networks of the proxies; empty means the loopback addresses.
    """

    def __init__(self, *, behind_proxy: bool, trusted_proxies: Sequence[str]) -> None:
        self._behind_proxy = behind_proxy
        self._trusted = [ipaddress.ip_network(text) for text in (trusted_proxies or LOOPBACK)]

    def address(self, scope: Scope) -> str:
        """Return the last forwarded address that is not a trusted proxy; a client can forge all addresses before it."""
        peer = (scope.get("client") or (UNKNOWN, 0))[0]
        if not self._behind_proxy or not self._is_trusted(peer):
            return plain(peer)
        forwarded = ",".join(Headers(scope=scope).getlist("x-forwarded-for"))
        for hop in reversed([part.strip() for part in forwarded.split(",") if part.strip()]):
            if not self._is_trusted(hop):
                return plain(hop)
        return plain(peer)

    def _is_trusted(self, address: str) -> bool:
        found = _parsed(address)
        return found is not None and any(found in network for network in self._trusted)


def plain(address: str) -> str:
    """Normalise an address; IPv6 is cut to its /64 network, since one machine can use any address within it."""
    found = _parsed(address)
    if found is None:
        return UNKNOWN
    if isinstance(found, ipaddress.IPv6Address) and not found.is_loopback:
        return str(ipaddress.ip_network((found, 64), strict=False).network_address)
    return str(found)


def _parsed(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Parse an address with or without a port, as some gateways append it; None if it is not an address."""
    try:
        found = ipaddress.ip_address(_without_port(address))
    except ValueError:
        return None
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return mapped or found


def _without_port(address: str) -> str:
    if address.startswith("["):
        return address[1:].partition("]")[0]
    return address.partition(":")[0] if address.count(":") == 1 else address
