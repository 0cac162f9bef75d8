"""The tables of docs/2-clinical/alarms.md, from the code: ``python -m tests.support.documents.alarms`` prints them.

With ``--write`` it puts them into the document instead.
"""

from functools import partial

from service.core.alarm_table import ALARM_RULES, NOT_ALARMS, AlarmPriority
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "2-clinical" / "alarms.md"


def alarm_table() -> str:
    """One row for alarms of the same priority and reason for it, that begin and end alike."""
    codes: dict[tuple[AlarmPriority, str, str, str], list[str]] = {}
    for rule in ALARM_RULES:
        begins = f"after {rule.delay_s:g} s" if rule.delay_s else "at once"
        key = (rule.priority, rule.why, f"{rule.scope}, {begins}", rule.ends)
        codes.setdefault(key, []).append(f"`{rule.code}`")
    head = ["| priority | alarms | because | begins | ends with |", "|---" * 5 + "|"]
    return "\n".join(
        head
        + [
            f"| {priority} | {', '.join(of)} | {why} | {begins} | {ends} |"
            for (priority, why, begins, ends), of in codes.items()
        ]
    )


def none_table() -> str:
    """One row a reason why holds are no alarm."""
    codes: dict[str, list[str]] = {}
    for reason, why in NOT_ALARMS.items():
        codes.setdefault(why, []).append(f"`{reason}`")
    head = ["| no alarm | because |", "|---|---|"]
    return "\n".join(head + [f"| {', '.join(of)} | {why} |" for why, of in codes.items()])


MADE = {"alarms": alarm_table, "none": none_table}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
