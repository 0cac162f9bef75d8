"""Whether a page that sends something is ours: browsers say in Origin which page it is, and no page can forge that."""

from collections.abc import Sequence
from urllib.parse import urlsplit

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


def is_ours(origin: str, host: str, allowed: Sequence[str], *, is_secure: bool) -> bool:
    """Whether an Origin is the page that this host serves, or one that the site lets in."""
    if origin in allowed:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    schemes = ("https",) if is_secure else ("http", "https")
    return bool(host) and parts.scheme in schemes and parts.netloc.lower() == host.lower()
