"""A falsified session of a virtual volunteer, measured for real: one model, three seconds of each case."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, ModelError
from lab.evaluation.integrity import session as session_module
from lab.evaluation.integrity.bench import check_plan, integrity_table, verdict
from lab.evaluation.integrity.cases import HONEST_S, cases, conditions
from lab.evaluation.integrity.session import FPS, SIGNALS, learn, run

pytestmark = [pytest.mark.long, pytest.mark.slow]


@pytest.fixture(scope="module")
def volunteer():
    return learn(3, 5, is_turned=False)


def measured(volunteer, name, seconds):
    case = next(case for case in cases() if case.name == name)
    return run(volunteer, replace(case, seconds=seconds))


def test_what_happens_below_a_blind_area_is_measured_against_the_patients_truth(volunteer):
    session = measured(volunteer, "no depth over the lowest 20%, skin raised, 8 mm", 1.0)
    assert len(session.seconds) == round(FPS)
    assert session.error_mm.shape == session.is_on.shape == (len(session.seconds), len(SIGNALS))
    assert session.is_measured.any()
    others = np.abs(session.error_mm[:, 1])  # thorax, which the camera sees
    assert np.nanmax(others) < 0.5
    blind = session.error_mm[2:, 2:]  # abdomen, and the cell and the point in the blind area, may not gate
    assert np.isnan(blind).all()
    assert not session.is_on[2:, 2:].any()
    assert any(reason.startswith("coverage_low: ") for reason in session.reasons)


def test_a_frozen_picture_is_held(volunteer):
    session = measured(volunteer, "frozen picture, 0% flicker", 1.0)
    assert verdict([session]).detected_s <= 0.1
    assert any("repeated" in reason or "frozen" in reason for reason in session.reasons)


@pytest.mark.parametrize(
    ("plan", "field"),
    [(([], 1, 1), "volunteer"), (([11], 1, 1), "volunteer"), (([1], -1, 1), "seed"), (([1], 1, 0), "jobs")],
)
def test_a_plan_out_of_bounds_is_refused_by_field(plan, field):
    with pytest.raises(InvalidValueError, match=field):
        check_plan(*plan)


def test_where_no_marker_is_found_nothing_is_learned_and_the_row_says_why(monkeypatch):
    case = next(one for one in conditions() if one.kind == "white shirt, plain stickers")
    monkeypatch.setattr(session_module, "TRAINING_S", 4.0)  # that it is never learned shows from the first frames
    unlearned = learn(3, 5, is_turned=False, departure=case.departure, must_learn=False)
    assert unlearned.refusal == "marker_lost", "not for want of time"
    session = run(unlearned, case)
    found = verdict([session])
    assert (found.measured_percent, found.largest_mm, found.on_s) == (0.0, 0.0, 0.0)
    assert session.reasons[0].startswith("marker_lost: ")
    assert integrity_table([[session]], name="conditions").rows[0][-1] == "lost"
    with pytest.raises(ModelError, match="not enough"):
        learn(3, 5, is_turned=False, departure=case.departure)


def test_a_ringed_sticker_is_found_on_white_and_the_breath_is_measured():
    case = next(one for one in conditions() if one.kind == "white shirt, ringed stickers")
    learned = learn(3, 5, is_turned=False, departure=case.departure)
    session = run(learned, replace(case, seconds=2.0))
    assert session.is_measured.all()
    assert np.nanmax(np.abs(session.error_mm)) < 0.6


def test_honest_frames_precede_every_falsification():
    assert {case.falsification.start_s for case in cases()} == {HONEST_S}
