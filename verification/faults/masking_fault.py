"""A fault that must not matter, with one beside it that must: a marker is covered while the first goes on.

The first may take the beam off by itself, which is safe; then that is what was seen.
"""

import random
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from verification.faults.kinds import Fault, FaultKind, MissedError, reported
from verification.faults.verdict import is_on_at

if TYPE_CHECKING:
    from verification.faults.rig import Rig

COVERED = reported("marker_lost", "layout_changed")


def beside(kind: FaultKind, latest_s: float = 0.3) -> FaultKind:
    """Return the kind, with a marker covered a moment later, while it goes on."""

    def inject(rig: "Rig", chance: random.Random) -> Fault:
        first = kind.inject(rig, chance)
        time.sleep(chance.uniform(0.03, latest_s))
        if not is_on_at(rig.edges, time.monotonic_ns()):
            return replace(first, is_of_itself=True)
        from verification.faults.frame_faults import cover_marker

        second = cover_marker(rig, chance)

        def undo() -> int | None:
            first.undo()
            return second.undo()

        if not first.is_going():
            undo()
            raise MissedError("it was over before the marker was covered")
        return replace(second, undo=undo, lasts_s=max(first.lasts_s, second.lasts_s))

    return replace(kind, inject=inject, reported=kind.reported | COVERED)
