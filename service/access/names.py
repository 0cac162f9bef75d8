"""Names: which can be had, and when two are the same."""

import unicodedata

from service.errors import BoundError

RESERVED = frozenset({"tidegate", "unknown", "nobody", "anonymous"})
MAX_LENGTH = 80
KEY_PREFIX = "key:"
NOT_IN_NAMES = "/:"
INVISIBLE = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters, by Unicode and to Python, that no reader sees: with one, two people could seem to have one name."""


def name_key(name: str) -> str:
    """Return what is equal for names that look the same to a reader: width, case and composition do not count."""
    return unicodedata.normalize("NFKC", name).casefold().strip()


def check_name(name: str) -> str:
    """Return a name that a person or key may have, or refuse it."""
    bound = f"1 to {MAX_LENGTH} printable characters without / and :, and not {', '.join(sorted(RESERVED))}"
    is_plain = name.isprintable() and name.strip() == name and not set(name) & {*NOT_IN_NAMES, *INVISIBLE}
    if not 1 <= len(name) <= MAX_LENGTH or not is_plain or name_key(name) in RESERVED:
        msg = f"name must be {bound}"
        raise BoundError(msg, field="name", value=name[:MAX_LENGTH], bound=bound)
    return name
