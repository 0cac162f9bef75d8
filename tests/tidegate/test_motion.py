"""Recordings measured from a program: the command's figures, frame by frame and as arrays, against a truth."""

import numpy as np
import pytest

import tidegate
from tests.support.command_line import measured


@pytest.fixture(scope="module")
def series(regular_volunteer, tmp_path_factory):
    out = tmp_path_factory.mktemp("python") / "out"
    cells = tidegate.PipelineSettings(cell_px=10)
    limits = tidegate.GateLimits(window=tidegate.AmplitudeWindow(lower=-20.0, upper=20.0), operator_timeout_s=0.0)
    found = tidegate.measure_recording(regular_volunteer / "recording.oni", out=out, settings=cells, limits=limits)
    return found, out


def test_a_recording_is_measured_close_to_its_truth(series, regular_volunteer):
    found, _ = series
    score = tidegate.score(found, tidegate.read_truth(regular_volunteer / "truth.npz"))
    assert score.frames == found.is_measured.sum() == len(found.state)
    assert max(score.whole_mm, score.thorax_mm, score.abdomen_mm) < score.regions_mm + 0.05 < 0.25
    assert score.volume_l < 0.02
    assert score.worst_mm >= score.whole_mm


def test_its_figures_are_those_of_the_command(regular_volunteer, tmp_path):
    command = measured(regular_volunteer, tmp_path / "command")
    tidegate.measure_recording(regular_volunteer / "recording.oni", out=tmp_path / "here")
    for name in ("motion.csv", "breathing.csv", "regions.npz", "motion_summary.json"):
        assert (tmp_path / "here" / name).read_bytes() == (command.out / name).read_bytes(), name


def test_the_series_is_what_the_files_hold(series):
    found, out = series
    again = tidegate.MotionSeries.read(out)
    np.testing.assert_array_equal(again.regions_mm, found.regions_mm)
    assert found.summary.measured == found.is_measured.sum()
    assert found.is_on.any()
    assert set(np.array(found.reasons)[found.is_on]) == {""}
    table = found.to_arrow()
    assert table.num_rows == len(found.state)
    assert table["abdomen_mm"].to_pylist()[5] == found.abdomen_mm[5]
    cells = np.array(table["regions_mm"][5].as_py()).reshape(found.regions_mm.shape[1:])
    np.testing.assert_array_equal(cells, found.regions_mm[5])


def test_frame_by_frame_a_model_is_learned_first(regular_volunteer):
    source = tidegate.open_recording(regular_volunteer / "recording.oni")
    found = tidegate.MotionSeries.of(tidegate.measure(source))
    assert source.description.is_live is source.is_live is False
    assert found.state[0] == "training"
    assert np.isnan(found.whole_mm[0])
    assert np.isnan(found.regions_mm[0]).all()
    assert found.is_measured[-1]
    assert np.isfinite(found.regions_mm[-1]).mean() > 0.9
    assert len(found.signal("abdomen").time_s) == found.is_measured.sum()
    with pytest.raises(tidegate.TidegateError, match="region is 'belly': must be whole, thorax or abdomen"):
        found.signal("belly")


def test_a_model_is_learned_kept_and_used_again(regular_volunteer, tmp_path):
    recording = regular_volunteer / "recording.oni"
    model = tidegate.train(tidegate.open_recording(recording))
    tidegate.save_model(model, str(tmp_path / "model.npz"))
    kept = tidegate.load_model(str(tmp_path / "model.npz"))
    frames = iter(tidegate.measure(tidegate.open_recording(recording), model=kept))
    assert sum(next(frames).motion is not None for _ in range(300)) > 100


def test_a_recording_too_short_to_learn_from_is_refused(regular_volunteer, monkeypatch):
    source = tidegate.open_recording(regular_volunteer / "recording.oni")
    monkeypatch.setattr(type(source), "__iter__", lambda _source: iter(()))
    with pytest.raises(tidegate.TidegateError, match="too short to learn a motion model"):
        tidegate.train(source)


def test_without_a_calibration_nothing_is_measured(regular_volunteer, tmp_path):
    alone = tmp_path / "recording.oni"
    alone.symlink_to(regular_volunteer / "recording.oni")
    with pytest.raises(tidegate.TidegateError, match="calibration is 'None': must be a calibration, or"):
        tidegate.measure_recording(alone)
    given = tidegate.load_calibration(str(regular_volunteer / "calibration.json"))
    assert next(iter(tidegate.measure(tidegate.open_recording(alone, given)))).frame_index == 0


def test_folders_and_truths_that_are_none_are_refused(tmp_path, series):
    with pytest.raises(tidegate.TidegateError, match="has no measured motion"):
        tidegate.MotionSeries.read(tmp_path)
    (tmp_path / "truth.npz").write_bytes(b"no")
    with pytest.raises(tidegate.TidegateError, match=r"truth\.npz: is no truth of a phantom"):
        tidegate.read_truth(tmp_path / "truth.npz")
    found, _ = series
    with pytest.raises(tidegate.TidegateError, match="truth is 'no frame of a measured time"):
        tidegate.score(found, tidegate.MotionSeries.of([]))


def test_only_recordings_of_makers_become_oni(tmp_path):
    with pytest.raises(tidegate.TidegateError, match=r"out is .*: must be a file that ends in \.oni"):
        tidegate.convert(tmp_path / "a.bag", tmp_path / "a.mp4")


def test_a_board_that_is_none_and_pictures_without_one_are_refused(tmp_path):
    with pytest.raises(tidegate.TidegateError, match="rows is 6: must be different from columns"):
        tidegate.calibrate(tmp_path, tmp_path, columns=6, rows=6, square_mm=20.0)
