"""The formulas by which everybody is judged, against arrays made by hand."""

import json

import numpy as np
import pytest

from lab.evaluation.methods.outcome import LOST, MEASURING, TRAINING, Outcome, Track, cell_means
from lab.evaluation.runs.marks import CELLS_MM, Mark, marks_table, reach
from lab.evaluation.runs.scores import assess_trust, correlation, score_method, score_run, scored_frames
from lab.evaluation.table import Table
from tests.support.evaluation.outcomes import N, breath, measured_track, outcome
from tests.support.evaluation.small_bench import small_run


def test_a_perfect_method_has_no_error_whatever_frame_it_starts_from():
    for first in (0, 7, 30):
        score = score_method(outcome(measured_track(breath(), first)), "ours")
        assert score.cells_mm == pytest.approx(0.0, abs=1e-4)
        assert score.frames == N - first
        assert score.volume_correlation == pytest.approx(1.0)
        assert score.points_correlation == pytest.approx(1.0)


def test_an_error_of_the_reference_frame_is_in_every_frame_after_it():
    score = score_method(outcome(measured_track(breath(), 10, 0.3)), "ours")
    after = N - 11
    assert score.cells_mm == pytest.approx(0.3 * after / (after + 1), abs=1e-4)
    assert score.whole_mm == pytest.approx(0.3 * after / (after + 1), abs=1e-4)
    assert score.points_max_mm == pytest.approx((0.3,) * 5, abs=1e-4)


def test_the_worst_frame_and_the_largest_cell_count_for_themselves():
    track = measured_track(breath(), 10)
    track.cells_mm[20, 3, 4] += 7.0
    track.cells_mm[30] += 0.5
    score = score_method(outcome(track), "ours")
    assert score.largest_mm == pytest.approx(7.0, abs=1e-4)
    assert score.worst_frame_mm == pytest.approx(0.5, abs=1e-4)
    assert score.cells_mm == pytest.approx((0.5 + 7.0 / 700) / (N - 10), abs=1e-4)


def test_standard_deviation_is_that_of_the_absolute_error_as_in_table_2():
    error = np.where(np.arange(N) % 2 == 0, 0.2, -0.4)
    score = score_method(outcome(measured_track(breath(), 10, error)), "ours")
    expected = np.abs(np.r_[0.0, error[11:]]).std()
    assert score.points_deviation_mm == pytest.approx((expected,) * 5, abs=1e-4)


def test_all_are_judged_from_where_the_last_of_them_has_learned():
    found = outcome(*(measured_track(breath(), first) for first in (12, 5, 20)))
    assert scored_frames(found).argmax() == 20
    assert {score_method(found, name).frames for name in found.tracks} == {N - 20}


def test_a_cell_that_is_not_measured_is_left_out_and_not_zero():
    track = measured_track(breath(), 10, 0.4)
    track.cells_mm[:, 0, :] = np.nan
    with_all = score_method(outcome(measured_track(breath(), 10, 0.4)), "ours").cells_mm
    assert score_method(outcome(track), "ours").cells_mm == pytest.approx(with_all, abs=1e-4)


def test_a_method_that_never_measured_has_no_score():
    found = outcome(Track.empty(N))
    assert score_method(found, "ours") is None
    assert assess_trust(found).lost_share == 0.0


def test_a_trusted_frame_off_by_a_millimetre_is_silently_wrong_and_a_doubted_one_is_not():
    error = np.zeros(N)
    error[[25, 26, 40]] = (1.0001, -1.5, 0.9999)
    found = outcome(measured_track(breath(), 10, error))
    assert (assess_trust(found).wrong, assess_trust(found).silently_wrong) == (2, 2)
    found.is_trusted[26] = False
    assert (assess_trust(found).wrong, assess_trust(found).silently_wrong) == (2, 1)


def test_lost_frames_are_counted_after_the_learning():
    track = measured_track(breath(), 20)
    for values in (track.cells_mm, track.wide_mm, track.points_mm):
        values[40:48] = np.nan
    state = np.full(N, TRAINING, np.int8)
    state[20:] = MEASURING
    state[40:48] = state[:5] = LOST
    assert assess_trust(outcome(track, state=state)).lost_share == pytest.approx(8 / 40)


def test_a_recording_that_was_never_learned_is_lost_altogether():
    assert assess_trust(outcome(Track.empty(N), state=np.full(N, LOST, np.int8))).lost_share == 1.0


def test_a_breath_hold_is_judged_in_the_hold():
    error = np.where(np.arange(N) >= 40, 0.6, 0.0)
    hold = {"name": "hold", "start_us": 4_000_000, "end_us": 5_000_000, "detail": {}}
    run = small_run("H01", group="dibh", scenario="dibh")
    scored = score_run(run, outcome(measured_track(breath(), 10, error), events=[hold]))
    assert scored.event_scores["ours"].frames == 10
    assert scored.event_scores["ours"].cells_mm == pytest.approx(0.6, abs=1e-4)
    assert scored.scores["ours"].cells_mm == pytest.approx(0.6 * 20 / 50, abs=1e-4)


def test_a_shifted_patient_is_judged_after_the_shift():
    shift = {"name": "shift", "start_us": 3_000_000, "end_us": 4_000_000, "detail": {}}
    run = small_run("S01", group="shift", scenario="shift")
    scored = score_run(run, outcome(measured_track(breath(), 10), events=[shift]))
    assert scored.event_scores["ours"].frames == 20


def test_correlation_knows_its_sign_and_its_gaps():
    x = breath()
    assert correlation(x, -2.0 * x + 3.0) == pytest.approx(-1.0)
    gaps = x.copy()
    gaps[::7] = np.nan
    assert correlation(gaps, x) == pytest.approx(1.0)
    assert np.isnan(correlation(x, np.ones(N)))


@pytest.mark.parametrize(("off_mm", "is_met"), [(0.1, True), (0.25, False)])
def test_a_mark_is_met_or_missed_by_the_number(off_mm, is_met):
    scored = score_run(small_run(), outcome(measured_track(breath(), 10, off_mm)))
    mark = next(mark for mark in reach([scored]) if "regular" in mark.name)
    assert (mark.bound, mark.is_met) == (CELLS_MM["table2"], is_met)
    table = marks_table([mark])
    assert table.rows[0][-1] == ("met" if is_met else "MISSED")
    assert table.failed == (frozenset() if is_met else {0})


def test_a_recording_that_could_not_be_measured_is_a_missed_mark():
    scored = score_run(small_run(), outcome(Track.empty(N)))
    assert not any(mark.is_met for mark in reach([scored]))


def test_a_mark_met_in_the_mean_names_the_recording_that_missed_it():
    good, bad = (
        score_run(small_run(n), outcome(measured_track(breath(), 10, e))) for n, e in (("D01", 0.0), ("D02", 0.2))
    )
    mark = next(mark for mark in reach([good, bad]) if "regular" in mark.name)
    assert mark.verdict == "met, not by D02"
    assert reach([good])[0].verdict == "met"


def test_thorax_against_abdomen_must_be_at_or_below_its_mark():
    mark = Mark(name="m", bound=-0.99, value=-0.995, worst=-0.995, worst_run="V01", recordings=1)
    assert mark.is_met
    assert not Mark(name="m", bound=-0.99, value=-0.9, worst=-0.9, worst_run="V01", recordings=1).is_met


def test_a_cell_is_the_mean_of_its_hundred_points():
    surface = np.arange(350.0 * 200.0).reshape(350, 200)
    cells = cell_means(surface)
    assert cells.shape == (35, 20)
    assert cells[3, 5] == pytest.approx(surface[30:40, 50:60].mean())


def test_an_outcome_reads_back_as_it_was_written(tmp_path):
    found = outcome(measured_track(breath(), 10, 0.2), plain=measured_track(breath(), 12))
    found.spectra["ours"] = np.array([0.9, 0.1])
    found.instruments["laser_mm"] = np.ones((N, 3))
    found.save(tmp_path / "measured.npz")
    back = Outcome.load(tmp_path / "measured.npz")
    assert score_method(back, "ours") == score_method(found, "ours") or score_method(
        back, "ours"
    ).cells_mm == pytest.approx(score_method(found, "ours").cells_mm, abs=1e-4)
    assert sorted(back.tracks) == ["ours", "plain"]
    assert back.spectra["ours"].tolist() == [0.9, 0.1]
    assert back.instruments["laser_mm"].shape == (N, 3)
    assert back.notes == {"lost": {}}
    assert [path.name for path in tmp_path.iterdir()] == ["measured.npz"]


def test_a_table_leaves_empty_what_was_not_measured_and_never_zero():
    table = Table(
        name="t", title="T", columns=("a", "b"), rows=(("x", None), ("y", float("nan")), ("z", 0.0)), digits=1
    )
    assert table.to_csv() == "a,b\nx,\ny,\nz,0.0\n"
    assert json.loads(json.dumps(table.to_json(), allow_nan=False))["rows"] == [["x", None], ["y", None], ["z", 0.0]]
    assert [table.text(row[1]) for row in table.rows] == ["-", "-", "0.0"]


def test_a_table_escapes_what_it_is_given():
    table = Table(name="t", title="T", columns=("<a>", "b"), rows=(("<i>", "<script>"),))
    assert not any(tag in table.to_html() for tag in ("<script>", "<a>", "<i>"))
    assert "&lt;script&gt;" in table.to_html()
