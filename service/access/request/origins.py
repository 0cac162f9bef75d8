"""Origin check against cross-site requests: browsers set the Origin header, and a page cannot forge it."""

from collections.abc import Sequence
from urllib.parse import urlsplit

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


def is_ours(origin: str, host: str, allowed: Sequence[str], *, is_secure: bool) -> bool:
    """Whether an Origin is this host's own page, or one that the site's settings allow."""
    if origin in allowed:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    schemes = ("https",) if is_secure else ("http", "https")
    return bool(host) and parts.scheme in schemes and parts.netloc.lower() == host.lower()
