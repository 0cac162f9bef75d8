"""Whether the body is where the phase says that it is: the level against the patient's own breaths, and its way.

The phase is time and knows no place. Each of the checks here is one that a regular breath passes, a third shallower or
half as deep again, and a breath that stops, slows, hurries, or is lifted on its way does not. In mm, s and per cent.
"""

from typing import NamedTuple

from engine.stages.breathing.course import Course
from engine.stages.breathing.habit import Habit
from engine.stages.breathing.shape import height_at
from engine.stages.breathing.turns import FALLING, RISING, Turns

EARLY_OR_LATE = 7.0
"""How far the phase may be off where the level is held against it [% of a breath]; regular breathing stays within 5."""
LEVEL_SHARE = 0.1
LEVEL_MM = 0.3
"""How far the level may be beside the usual, as a share of a breath and, for the heart and noise, more [mm]."""
LEAST_ADVANCE = 0.6
MOST_ADVANCE = 1.7
"""How far an inhale may have come, as a share of how far a usual one has come by then."""
WAY_S = 0.25
LEAST_WAY = 0.35
WAY_OFF = 5.0
"""Over which time the way is judged [s], which share of the usual is enough, and how far the phase may be off [%]."""


class Place(NamedTuple):
    """Where a signal stands at a moment: the phase told [%], the last end of exhale and the level [mm]."""

    percent: float
    is_waiting: bool
    low: float
    seconds: float
    level: float


def is_elsewhere(place: Place, habit: Habit, turns: Turns, course: Course) -> bool:
    """Whether the body is not where the phase says; also where there is nothing to compare it with."""
    # Written so that NaN is elsewhere: every comparison with it is false.
    if turns.way == FALLING:
        return not (
            _is_exhale(place, habit, turns) and _is_under_way(place, habit, FALLING, course, turns.high - place.low)
        )
    if turns.way == RISING:
        # From the rise on to the next fall; the end of inhale lies between.
        is_past_end = place.percent < 50.0 * (habit.down_share + habit.up_share)
        place = place._replace(percent=place.percent + 100.0 * is_past_end)
        return not (_is_inhale(place, habit, turns, course) and _is_under_way(place, habit, RISING, course, habit.rise))
    return True


def _is_exhale(place: Place, habit: Habit, turns: Turns) -> bool:
    """Whether the level is that of an exhale at that phase; how deep it is, is known from its beginning."""
    shape, slack = habit.shape, _slack_mm(habit)
    early, late = max(place.percent - EARLY_OR_LATE, 0.0), place.percent + EARLY_OR_LATE
    bottom = 100.0 * shape.index(min(shape)) / len(shape)
    heights = [height_at(shape, early), height_at(shape, place.percent), height_at(shape, late)]
    if late >= bottom:
        # A rest may be longer than usual: how late it is, the phase itself says.
        heights.append(height_at(shape, max(bottom, place.percent - 2.0 * EARLY_OR_LATE)))
    # A body that has not begun to rise is not where a breath has.
    has_risen = place.level - turns.low > 0.5 * slack
    highest = max(heights) if has_risen else height_at(shape, min(early, bottom))
    depth, height = turns.high - place.low, place.level - place.low
    return depth * min(heights) - slack <= height <= depth * highest + slack


def _is_inhale(place: Place, habit: Habit, turns: Turns, course: Course) -> bool:
    """Whether an inhale has come about as far as a usual one has since it was seen to rise."""
    slack, percent = _slack_mm(habit), place.percent
    is_near_end = percent > 100.0 - EARLY_OR_LATE
    reached = turns.high if is_near_end else place.level
    least = LEAST_ADVANCE * _advance(habit, percent) - LEVEL_MM
    most = MOST_ADVANCE * _advance(habit, percent + EARLY_OR_LATE) + slack
    is_far_enough = least <= reached - course.rose and place.level - course.rose <= most
    is_going = is_near_end or place.level >= turns.high - slack
    # What waits at the top is not where a breath has fallen.
    past = max(percent - EARLY_OR_LATE, 100.0)
    is_low_enough = place.level - place.low <= (turns.high - place.low) * height_at(habit.shape, past) + slack
    return is_far_enough and is_going and is_low_enough


def _is_under_way(place: Place, habit: Habit, way: int, course: Course, depth: float) -> bool:
    """Whether the signal moves where a usual one is on its flank; how late a turn is, the phase itself says."""
    since = next((one for one in reversed(course.path) if place.seconds - one[0] >= WAY_S), None)
    if since is None or place.is_waiting:
        return True
    back = 100.0 * (place.seconds - since[0]) / habit.period_s
    usual = min(
        way * depth * (height_at(habit.shape, at) - height_at(habit.shape, at - back))
        for at in (place.percent - WAY_OFF, place.percent, place.percent + WAY_OFF)
    )
    least = LEAST_WAY * usual - LEVEL_MM
    return least <= 0.0 or way * (place.level - since[1]) >= least


def _advance(habit: Habit, percent: float) -> float:
    """How far a usual inhale has come by a phase, from where it is seen to rise [mm]."""
    begun = height_at(habit.shape, 100.0 * habit.up_share)
    return habit.rise * (height_at(habit.shape, min(percent, 100.0)) - begun)


def _slack_mm(habit: Habit) -> float:
    return LEVEL_SHARE * habit.rise + LEVEL_MM
