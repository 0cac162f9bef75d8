"""One sentence for each hold reason, as the page shows it: from the page's English language file."""

import json
from importlib import resources

from engine.core.gate_state import HoldReason

_LANGUAGE = resources.files("service") / "web" / "dashboard" / "lang" / "en.json"


def _texts() -> dict[HoldReason, str]:
    words = json.loads(_LANGUAGE.read_text(encoding="utf-8"))
    return {reason: words[f"hold.{reason.value}.what"] for reason in HoldReason}


HOLD_TEXTS: dict[HoldReason, str] = _texts()


def hold_text(reason: HoldReason | None) -> str | None:
    """Return the sentence of a reason; None for None."""
    return None if reason is None else HOLD_TEXTS[reason]
