"""Interlocks in any order, for any time, in a running loop: the line is on exactly after a full dwell free of all."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings, strategies as st

from engine.core.breath import Breath, BreathEvent, BreathEventKind
from engine.core.commands import HoldBeam, ReleaseBeam
from engine.core.frames import LostReason, MeasurementState
from tests.support.control.armed_bench import ON, lying_at, on_bench
from tests.support.control.loop_bench import DEPTH, after, good
from tests.support.gating.streams import FRAMES_A_DWELL, LIMITS, motion_of, unmeasured

LIMITED = replace(LIMITS, holding_events=frozenset({BreathEventKind.COUGH}))
COUGH = Breath(events=(BreathEvent(kind=BreathEventKind.COUGH, start_us=0, confidence=1.0),))
REPEATS_ALLOWED = 2
"""Pictures of 33 ms within 100 ms; one more is a fault."""
KINDS = ("free", "frozen", "held by hand", "shifted", "cough", "lost", "outside")

stretches = st.lists(st.tuples(st.sampled_from(KINDS), st.integers(1, 7)), min_size=1, max_size=8)


def _spoils(bench, at: int, kind: str) -> None:
    here = bench.pipeline.spoil[at]
    if kind == "shifted":
        bench.pipeline.spoil[at] = bench.pipeline.spoil[199]
    elif kind == "cough":
        bench.pipeline.spoil[at] = lambda frame: replace(here(frame), breaths=(COUGH,))
    elif kind == "lost":
        bench.pipeline.spoil[at] = lambda frame: unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST)
    elif kind == "outside":
        bench.pipeline.spoil[at] = lambda frame: replace(
            here(frame), motion=replace(motion_of(3.2), surface_mm=here(frame).motion.surface_mm)
        )


def _frozen(number: int):
    """A picture of its own for each stretch: one that came before would be known."""

    def step(source, timeout_s):
        return replace(good(source, timeout_s), depth_mm=DEPTH + np.uint16(1_000 + number))

    return step


def _asked(bench, kind: str, before: str, still):
    """The step that delivers a frame, with what a person asks for just before it."""
    shown = still if kind == "frozen" else good
    if kind == "held by hand" and before != kind:
        return after(bench.ask(HoldBeam(operator="bob")))
    if before == "held by hand" and kind != before:
        release = bench.ask(ReleaseBeam(operator="bob"))
        return lambda source, timeout_s: (release(), shown(source, timeout_s))[1]
    return shown


@settings(max_examples=60, deadline=None)
@given(stretches)
def test_the_line_is_on_exactly_after_a_full_dwell_without_any_interlock(drawn):
    # One of a kind does not follow another: a stretch of alike pictures begins with a new one.
    apart = [one for before, one in zip([None, *drawn], drawn, strict=False) if before is None or before[0] != one[0]]
    kinds = [kind for kind, length in [*apart, ("free", FRAMES_A_DWELL + 1)] for _ in range(length)]
    bench = on_bench([], limits=LIMITED)
    lying_at(bench, 150, 7.0)
    number = 0
    for before, kind in zip(["free", *kinds], kinds, strict=False):
        number += before != kind
        bench.source.script.append(_asked(bench, kind, before, _frozen(number)))
    for number, kind in enumerate(kinds):
        _spoils(bench, ON + 1 + number, kind)
    records = bench.run().records()
    free_frames, repeats = FRAMES_A_DWELL, 0
    for number, (before, kind) in enumerate(zip(["free", *kinds], kinds, strict=False)):
        # The first of alike pictures is like any other; a release is obeyed when its frame was decided on.
        is_clear = kind == "free" or (kind == "frozen" and before != kind)
        is_clear = is_clear and before != "held by hand"
        free_frames = free_frames + 1 if is_clear else 0
        repeats += kind == before == "frozen"
        if repeats > REPEATS_ALLOWED:
            free_frames = -len(kinds)  # a fault, which does not clear
        assert records[ON + 1 + number].line_on is (free_frames >= FRAMES_A_DWELL), (number, before, kind)
