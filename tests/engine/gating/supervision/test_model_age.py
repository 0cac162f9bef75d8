"""How old the model in use is: since it was learned, waited or not, or found alike; by the host's clock alone."""

import pytest

from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.gating.supervision.supervisor import NS_PER_MIN, ModelAge
from tests.support.gating.streams import LIMITS

LONGEST_NS = int(LIMITS.max_model_age_min * NS_PER_MIN)
FIRST, SECOND = object(), object()


def event_of(kind: LearningEventKind, **figures: object) -> LearningEvent:
    return LearningEvent(kind=kind, detail="", timestamp_us=0, figures=figures)


def is_held(age: ModelAge, now_ns: int, model: object = FIRST, *notices: LearningEvent) -> bool:
    found = age.check(model, notices, now_ns)
    assert found is None or found.reason is HoldReason.MODEL_OLD
    return found is not None


def test_a_model_is_too_old_beyond_its_limit_counted_from_when_it_was_first_measured_with():
    age = ModelAge(LIMITS)
    assert not is_held(age, 5, None)
    assert not is_held(age, 10)
    assert not is_held(age, 10 + LONGEST_NS)
    assert is_held(age, 10 + LONGEST_NS + 1)


def test_another_model_begins_anew():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    assert not is_held(
        age, LONGEST_NS + 1, SECOND, event_of(LearningEventKind.READY), event_of(LearningEventKind.SWAPPED)
    )
    assert not is_held(age, 2 * LONGEST_NS, SECOND)
    assert is_held(age, 2 * LONGEST_NS + 2, SECOND)


def test_a_model_that_waited_was_learned_before_it_waited():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    is_held(age, 100, FIRST, event_of(LearningEventKind.READY))
    is_held(age, 100 + LONGEST_NS // 2, SECOND, event_of(LearningEventKind.SWAPPED))
    assert not is_held(age, 100 + LONGEST_NS, SECOND)
    assert is_held(age, 101 + LONGEST_NS, SECOND)


@pytest.mark.parametrize(("is_accepted", "is_old"), [(True, False), (False, True)])
def test_a_stored_model_found_alike_is_young_again(is_accepted, is_old):
    age = ModelAge(LIMITS)
    is_held(age, 0)
    is_held(age, LONGEST_NS, FIRST, event_of(LearningEventKind.COMPARED, is_accepted=is_accepted))
    assert is_held(age, LONGEST_NS + 1) is is_old


@pytest.mark.parametrize(
    "kind",
    [LearningEventKind.STARTED, LearningEventKind.READY, LearningEventKind.REFUSED, LearningEventKind.ZERO_NEEDED],
)
def test_other_news_makes_no_model_younger(kind):
    age = ModelAge(LIMITS)
    is_held(age, 0)
    is_held(age, LONGEST_NS, FIRST, event_of(kind))
    assert is_held(age, LONGEST_NS + 1)


def test_no_model_has_no_age():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    assert not is_held(age, 3 * LONGEST_NS, None)


def test_a_model_that_took_over_unannounced_is_as_young_as_that():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    assert not is_held(age, LONGEST_NS + 1, SECOND)
    assert not is_held(age, 2 * LONGEST_NS, SECOND)
    assert is_held(age, 2 * LONGEST_NS + 2, SECOND)


def test_a_model_learned_from_nothing_has_nothing_of_the_age_of_one_that_waited_before():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    is_held(age, 100, FIRST, event_of(LearningEventKind.READY))
    is_held(age, 200, SECOND, event_of(LearningEventKind.SWAPPED))
    is_held(age, LONGEST_NS, None)
    is_held(age, LONGEST_NS + 50, FIRST, event_of(LearningEventKind.SWAPPED))
    assert not is_held(age, 2 * LONGEST_NS, FIRST)


def test_a_hold_states_how_old_the_model_is():
    age = ModelAge(LIMITS)
    is_held(age, 0)
    minutes = LIMITS.max_model_age_min
    detail = f"trained or compared {minutes + 2:.0f} min ago, {minutes:g} allowed"
    assert age.check(FIRST, (), LONGEST_NS + 2 * NS_PER_MIN).detail == detail
