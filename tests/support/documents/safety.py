"""The tables of docs/2-clinical/safety.md, from the code: ``python -m tests.support.documents.safety`` prints them.

With ``--write`` it puts them into the document instead.
"""

from functools import partial

from engine.core.gate_state import INTERLOCKS, GateState, HoldReason
from engine.gating.gate import EventKind, next_state
from service.core.alarm_table import HOLD_TEXTS
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "2-clinical" / "safety.md"


def transition_table() -> str:
    """One row a state, one column a kind of event."""
    kinds = list(EventKind)
    head = [f"| from | {' | '.join(kinds)} |", "|---" * (len(kinds) + 1) + "|"]
    rows = [f"| **{state}** | {' | '.join(next_state(state, kind) for kind in kinds)} |" for state in GateState]
    return "\n".join(head + rows)


def reason_lists() -> str:
    """Which reasons clear by themselves, and which latch."""
    clearing = ", ".join(f"`{reason}`" for reason in HoldReason if not reason.is_fault)
    latching = ", ".join(f"`{reason}`" for reason in HoldReason if reason.is_fault)
    return (
        f"Clear by themselves, after a full dwell: {clearing}.\n\nLatch until a named person acknowledges: {latching}."
    )


def interlock_table() -> str:
    """One row an interlock: its code and words, what trips it, whether it latches, what bounds it, where it is from."""
    head = ["| code | shown as | trips on | is a | bounded by: default, lowest to highest | from |", "|---" * 6 + "|"]
    return "\n".join(head + [_interlock_row(reason) for reason in INTERLOCKS])


def _interlock_row(reason: HoldReason) -> str:
    bounds = "; ".join(_bound(name) for name in reason.row.settings) or "-"
    kind = "fault" if reason.is_fault else "hold"
    return f"| `{reason}` | {HOLD_TEXTS[reason]} | {reason.row.trips} | {kind} | {bounds} | {reason.row.source} |"


def _bound(name: str) -> str:
    field = Settings.model_fields[name]
    setting = f"`{setting_name(name)}`"
    if isinstance(field.default, tuple):
        return f"{setting}: {', '.join(field.default) or 'none'}"
    if isinstance(field.default, bool):
        return f"{setting}: {str(field.default).lower()}"
    bounds = {kind: getattr(one, kind) for one in field.metadata for kind in ("ge", "le") if hasattr(one, kind)}
    default = "by kind" if field.default is None else f"{field.default:g}"
    return f"{setting}: {default}, {bounds['ge']:g} to {bounds['le']:g}"


MADE = {"transitions": transition_table, "reasons": reason_lists, "interlocks": interlock_table}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
