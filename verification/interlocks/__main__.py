"""Trip every interlock in a live run and print what the beam line saw: ``python -m verification.interlocks``."""

import sys
import tempfile
from pathlib import Path

from verification.interlocks.live_run import NEVER_ON, is_ever_on, rows, run_all
from verification.interlocks.trips import TRIPS

HEAD = ("interlock", "is a", "tripped by", "line", "ms to off", "came back")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        never_on = [reason for reason in NEVER_ON if not is_ever_on(Path(folder), reason)]
        table = [HEAD, *rows(run_all(Path(folder), TRIPS))]
    table += [(reason, "hold", NEVER_ON[reason][0], "never on", "-", "-") for reason in never_on]
    widths = [max(len(row[column]) for row in table) for column in range(len(HEAD))]
    for row in table:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        sys.stdout.write("  ".join(cells).rstrip() + "\n")


if __name__ == "__main__":
    main()
