"""The tables of docs/2-clinical/alarms.md, from the code: ``python -m tests.support.documents.alarms`` prints them.

With ``--write`` it puts them into the document instead.
"""

from functools import partial

from service.core.alarm_table import ALARM_RULES, NOT_ALARMS, AlarmPriority, AlarmRule
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "2-clinical" / "alarms.md"


def alarm_table() -> str:
    """One row an alarm: priority, code, text, when it begins, whether it latches, what clears it."""
    head = ["| priority | code | shown as | alarm while | begins after | latches | cleared by |", "|---" * 7 + "|"]
    return "\n".join(head + [_row(rule) for rule in ALARM_RULES])


def reason_table() -> str:
    """One row a reason for a priority, with the codes that have it."""
    codes: dict[tuple[AlarmPriority, str], list[str]] = {}
    for rule in ALARM_RULES:
        codes.setdefault((rule.priority, rule.why), []).append(f"`{rule.code}`")
    head = ["| priority | because | alarms |", "|---|---|---|"]
    return "\n".join(head + [f"| {priority} | {why} | {', '.join(of)} |" for (priority, why), of in codes.items()])


def none_table() -> str:
    """One row a reason why holds are no alarm."""
    codes: dict[str, list[str]] = {}
    for reason, why in NOT_ALARMS.items():
        codes.setdefault(why, []).append(f"`{reason}`")
    head = ["| no alarm | because |", "|---|---|"]
    return "\n".join(head + [f"| {', '.join(of)} | {why} |" for why, of in codes.items()])


def _row(rule: AlarmRule) -> str:
    delay = f"{rule.delay_s:g} s" if rule.delay_s else "at once"
    latches = "yes" if rule.latches else "no"
    return f"| {rule.priority} | `{rule.code}` | {rule.text} | {rule.scope} | {delay} | {latches} | {rule.ends} |"


MADE = {"alarms": alarm_table, "reasons": reason_table, "none": none_table}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
