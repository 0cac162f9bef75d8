"""Texts of earlier versions that stand on tapes, and their present wording.

A reworded text is not a changed decision. A text that a transition's detail may hold is added here when it is
reworded, so that earlier tapes still replay; `tests/engine/offline/replay/test_earlier_tapes.py` fails otherwise.
"""

from collections.abc import Mapping

PRESENT_TEXTS: Mapping[str, str] = {
    "the lease lapsed while the line was told": "the lease lapsed before the line had answered",
    "the body is not where the phase says": "the level does not match the phase",
    "nothing was measured for a moment": "not measured for a moment",
}
"""Earlier text to present text."""


def in_present_words(text: str) -> str:
    """Return a recorded text with each earlier text replaced by its present wording."""
    for earlier, present in PRESENT_TEXTS.items():
        text = text.replace(earlier, present)
    return text
