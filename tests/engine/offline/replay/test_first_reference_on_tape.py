"""A tape names the first reference of the fraction that its session continued."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import RecordingError
from engine.core.reference import NODES, FirstReference, ReferenceMoment
from engine.motion.settings import PipelineSettings
from engine.offline.replay.header import METHOD, Frames, TapeHeader, read_head
from tests.support.gating.streams import LIMITS
from tests.support.motion.small_scene import CALIBRATION
from tests.support.replay.scripted_tape import NO_MODELS

FIRST = FirstReference(
    calibration_sha256=CALIBRATION.sha256,
    layout_sha256="d" * 64,
    regions_mm=np.array([850.1234, np.nan]),
    surface_mm=np.arange(3.0 * NODES).reshape(NODES, 3),
    plane_mm=850.0,
    volume_l=0.1 + 0.2,
)
HEAD = TapeHeader(
    session_id="5e" * 16,
    limits=LIMITS,
    measuring=PipelineSettings(),
    calibration=CALIBRATION,
    model=None,
    frames=Frames(kind=None),
    software="test",
    machine={},
)


@pytest.mark.parametrize("first", [None, FIRST], ids=["none", "first"])
def test_the_head_names_it(first):
    again = read_head(replace(HEAD, first_reference=first).encoded(NO_MODELS), NO_MODELS)
    assert (again.method, again.limits) == (METHOD, LIMITS)
    assert (again.first_reference is None) == (first is None)
    if again.first_reference is not None:
        assert again.first_reference.to_json() == FIRST.to_json()
        assert np.array_equal(again.first_reference.surface_mm, FIRST.surface_mm)


def test_the_head_names_the_plan_s_position():
    plan = replace(FIRST, moment=ReferenceMoment.END_EXHALE)
    encoded = replace(HEAD, plan_position=plan).encoded(NO_MODELS)
    again = read_head(encoded, NO_MODELS)
    assert again.first_reference is None
    assert again.plan_position is not None
    assert again.plan_position.to_json() == plan.to_json()


def test_a_damaged_one_is_a_damaged_head():
    encoded = HEAD.encoded(NO_MODELS) | {"first_reference": "{}"}
    with pytest.raises(RecordingError, match="head is damaged"):
        read_head(encoded, NO_MODELS)
