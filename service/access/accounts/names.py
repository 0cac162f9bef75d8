"""Names of users and keys: which are allowed, and when two count as the same."""

import unicodedata

from service.core.errors import BoundError

RESERVED = frozenset({"tidegate", "unknown", "nobody", "anonymous"})
MAX_LENGTH = 80
KEY_PREFIX = "key:"
MACHINE_PREFIX = "machine:"
NOT_IN_NAMES = "/:"
INVISIBLE = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters by Unicode that are rendered blank: they would let two accounts appear to have the same name."""


def name_key(name: str) -> str:
    """Return the key by which names are compared: NFKC, case folded, without surrounding spaces."""
    return unicodedata.normalize("NFKC", name).casefold().strip()


def check_name(name: str) -> str:
    """Return the name unchanged if it is allowed; raise BoundError otherwise."""
    bound = f"1 to {MAX_LENGTH} printable characters without / and :, and not {', '.join(sorted(RESERVED))}"
    is_plain = name.isprintable() and name.strip() == name and not set(name) & {*NOT_IN_NAMES, *INVISIBLE}
    if not 1 <= len(name) <= MAX_LENGTH or not is_plain or name_key(name) in RESERVED:
        msg = f"name must be {bound}"
        raise BoundError(msg, field="name", value=name[:MAX_LENGTH], bound=bound)
    return name
