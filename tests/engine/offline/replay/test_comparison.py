"""Replays on another processor: numbers within 1e-3 mm, decisions equal, and the output says so."""

from dataclasses import replace

import pytest

from engine.core.commands import Arm
from engine.offline.replay.comparison import (
    BIT_FOR_BIT,
    MOTION_MM,
    PROCESSOR,
    comparison_of,
    this_machine,
    within_rounding,
)
from tests.support.control.loop_bench import after, good
from tests.support.replay.scripted_tape import lived, replayed, taped

HERE = this_machine()
OTHER = HERE | {"opencv features": "SSE SSE2 SSE3"}
FRAME = 20


@pytest.fixture(scope="module")
def tape(tmp_path_factory):
    """A session that is armed and has the beam on at FRAME."""
    one = taped()
    lived(
        [
            *(good for _ in range(5)),
            after(lambda: one.loop.submit(Arm(operator="A. Therapist"))),
            *(good for _ in range(30)),
        ],
        one,
    )
    return one.write(tmp_path_factory.mktemp("tapes") / "a.tape")


def moved_by(step_mm):
    """Measure so much more on every frame."""

    def move(frame):
        motion = frame.motion
        moved = {name: getattr(motion, name) + step_mm for name in ("whole_mm", "thorax_mm", "abdomen_mm")}
        return replace(frame, motion=replace(motion, regions_depth_mm=motion.regions_depth_mm + step_mm, **moved))

    return dict.fromkeys(range(100), move)


def test_the_same_machine_is_compared_to_the_last_bit_whatever_its_name():
    assert comparison_of(HERE, HERE) == BIT_FOR_BIT
    assert comparison_of(HERE | {PROCESSOR: "another of the same features"}, HERE).is_exact


@pytest.mark.parametrize("name", [name for name in HERE if name != PROCESSOR])
def test_other_features_or_libraries_and_a_tape_that_does_not_name_them_are_compared_within_rounding(name):
    for recorded in (HERE | {name: "another"}, {key: value for key, value in HERE.items() if key != name}):
        found = comparison_of(recorded, HERE)
        assert (found.is_exact, found.tolerances["whole_mm"]) == (False, MOTION_MM)
        (reason,) = found.reasons
        assert name in reason


def test_a_rounding_is_a_difference_on_the_same_processor_and_none_on_another(tape):
    assert replayed(tape, spoil=moved_by(5e-4)).difference is not None
    again = replayed(tape, spoil=moved_by(5e-4), comparison=comparison_of(OTHER, HERE))
    assert again.difference is None
    assert (again.frames, again.identical_frames) == (36, 0)
    assert "beam_on" in {row["to"] for row in again.transitions}


def test_on_another_processor_too_the_same_bits_are_counted(tape):
    again = replayed(tape, comparison=comparison_of(OTHER, HERE))
    assert (again.difference, again.frames, again.identical_frames) == (None, 36, 36)


def test_more_than_a_rounding_is_a_difference_of_numbers(tape):
    difference = replayed(tape, spoil=moved_by(2e-3), comparison=within_rounding()).difference
    assert (difference.frame, difference.is_of_numbers) == (0, True)
    assert "whole_mm" in difference.recorded
    assert "digest" not in difference.recorded


def test_another_decision_is_a_difference_however_near_the_numbers_are(tape):
    def lost(frame):
        return replace(
            frame, motion=replace(frame.motion, projection=replace(frame.motion.projection, valid_share=0.0))
        )

    difference = replayed(tape, spoil={FRAME: lost}, comparison=within_rounding()).difference
    assert (difference.frame, difference.is_of_numbers) == (FRAME, False)
    assert "beam_on" in difference.recorded


def test_a_row_agrees_in_everything_but_its_roundings():
    within = within_rounding()
    row = {
        "whole_mm": 1.0,
        "volume_l": 0.5,
        "gate": "hold",
        "reason": None,
        "line_on": False,
        "decided_ns": 7,
        "regions_mm": [1.0, float("nan")],
        "named_mm": None,
        "detail": "moved 5.1 mm along the couch, 5 allowed",
        "rate_per_min": 12.0,
        "digest": "a",
    }
    same = {"whole_mm": 1.0005, "volume_l": 0.5001, "regions_mm": [0.9995, float("nan")], "rate_per_min": 13.0}
    same |= {"detail": "moved 5.2 mm along the couch, 5 allowed", "digest": "b"}
    for name, value in same.items():
        assert within.agrees(row, row | {name: value}), name
        assert not BIT_FOR_BIT.agrees(row, row | {name: value}) or "nan" in str(value), name
    other = {"whole_mm": 1.002, "volume_l": 0.501, "gate": "beam_on", "reason": "dwell", "line_on": True}
    other |= {"decided_ns": 8, "regions_mm": [1.002, float("nan")], "named_mm": [1.0]}
    other |= {"detail": "moved 5.3 mm along the couch, 5 allowed"}
    for name, value in other.items():
        assert not within.agrees(row, row | {name: value}), name
    for regions in ([1.0, 2.0], [1.0], None, "1.0"):
        assert not within.agrees(row, row | {"regions_mm": regions})
    assert not within.agrees(row, row | {"detail": "turned 5.1 mm along the couch, 5 allowed"})
    assert not within.agrees(row, row | {"more": 1})


def test_a_machine_is_named_in_words():
    assert all(isinstance(value, str) for value in HERE.values())
    assert {"opencv features", "numpy features", "blas kernels", "numpy", "opencv", "architecture"} <= set(HERE)
    assert "SSE" in HERE["opencv features"] or HERE["architecture"] != "x86_64"


def test_a_tape_from_before_the_features_may_have_other_words_but_no_other_reason():
    """Texts were reworded when the features came: a reworded detail is no changed decision."""
    then = {"to_state": "hold", "reason": "poor_fit", "detail": "2.10 mm unexplained, 2.00 allowed"}
    now = then | {"detail": "residual 2.10 mm, 2.00 mm allowed"}
    earlier = comparison_of({"processor": "any"}, this_machine())
    assert earlier.agrees(then, now)
    assert not earlier.agrees(then, now | {"reason": "jump"})
    elsewhere = comparison_of(this_machine() | {"opencv features": "SSE"}, this_machine())
    assert not elsewhere.agrees(then, now)
