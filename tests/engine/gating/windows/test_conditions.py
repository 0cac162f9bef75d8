"""What a condition keeps over an unusable frame: it is entered again, and what a patient did is not forgotten."""

from dataclasses import replace

import pytest

from engine.gating.windows.conditions import ConditionState, HoldStage, interrupted, left

HELD = ConditionState(
    is_inside=True,
    stage=HoldStage.HELD,
    since_us=7,
    lowest=1.0,
    highest=2.0,
    settled_at=1.5,
    held_since_us=5,
    holds=3,
)


@pytest.mark.parametrize("stage", [HoldStage.DRIFTED, HoldStage.OVER])
def test_a_breath_hold_that_ended_stays_ended(stage):
    ended = replace(HELD, stage=stage)
    assert interrupted((ended,)) == (replace(ended, is_inside=False),)


@pytest.mark.parametrize("stage", [HoldStage.AWAITED, HoldStage.SETTLING, HoldStage.HELD])
def test_any_other_begins_again_with_its_count_its_level_and_its_time(stage):
    assert (
        interrupted((replace(HELD, stage=stage), HELD))
        == (ConditionState(settled_at=1.5, held_since_us=5, holds=3),) * 2
    )


def test_a_condition_that_is_left_is_only_not_inside():
    assert left((HELD, replace(HELD, is_inside=False))) == (replace(HELD, is_inside=False),) * 2
