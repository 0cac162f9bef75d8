"""Identifiers of patients, plans, fractions and persons: as they are stored and shown, and when two are the same.

What is shown is what is compared: text is stored in NFC, without surrounding and double spaces. Two identifiers are the
same where their keys are: without compatibility characters and case, and with a Cyrillic or Greek letter that looks
like a Latin one taken for it.
"""

import unicodedata

# fmt: off
_CYRILLIC = "АВЕЅІЈКМНОРСТУХаеһіјорсѕухԁԛԝү", "ABESIJKMHOPCTYXaehijopcsyxdqwy"  # noqa: RUF001 - these letters are meant
_GREEK = "ΑΒΕΖΗΙΚΜΝΟΡΤΥΧανορτχ", "ABEZHIKMNOPTYXavoptx"
_LATIN = "ıɑɡ", "iag"  # noqa: RUF001
# fmt: on
_LOOK_ALIKE = str.maketrans(*("".join(parts) for parts in zip(_CYRILLIC, _GREEK, _LATIN, strict=True)))
INVISIBLE = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters by Unicode that are rendered blank."""
_ONE_SCRIPT = dict.fromkeys(("HIRAGANA", "KATAKANA", "HANGUL", "BOPOMOFO", "IDEOGRAPHIC"), "CJK")
"""Scripts that are written together in one name."""


def identity_text(text: str) -> str:
    """Return an identifier as it is stored and shown; raise ValueError where nothing of it can be seen."""
    shown = " ".join(filter(None, unicodedata.normalize("NFC", text).split(" ")))
    if not shown or not shown.isprintable() or set(shown) & INVISIBLE:
        msg = "must be printable characters, not only spaces"
        raise ValueError(msg)
    return shown


def identity_key(text: str) -> str:
    """Return the key by which identifiers are compared."""
    plain = unicodedata.normalize("NFKC", text).translate(_LOOK_ALIKE).casefold().translate(_LOOK_ALIKE)
    return " ".join(plain.split())


def scripts(text: str) -> frozenset[str]:
    """Return the scripts of the letters of a text, by the names of Unicode; those of East Asia count as one."""
    names = (unicodedata.name(sign, "").split(" ")[0] for sign in unicodedata.normalize("NFKC", text) if sign.isalpha())
    return frozenset(_ONE_SCRIPT.get(name, name) for name in names if name)


def is_of_one_script(text: str) -> bool:
    """Whether all letters of a person's name are of one script, so that none can pass for a letter of another."""
    return len(scripts(text)) <= 1
