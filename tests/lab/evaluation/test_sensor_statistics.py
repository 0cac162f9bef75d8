"""Statistics of still surfaces find what a sensor model was given, and a fit finds it again."""

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.core.errors import InvalidValueError
from lab.commands.evaluate.command import evaluate
from lab.evaluation import sensor_statistics
from lab.evaluation.sensor_statistics import IN_SPACE, fit_sensor, simulated, statistics_of, table
from lab.phantom.rig import STEPS_A_MM
from lab.phantom.sensor import SensorModel

pytestmark = pytest.mark.slow
ROWS, COLUMNS = np.mgrid[0:480, 0:640].astype(np.float32)
SLOPE_MM = 560.0 + 0.3 * ROWS + 0.2 * COLUMNS  # 560 to 830 mm: two bands, many phases


def read(model, frames=12, surface_mm=SLOPE_MM):
    return simulated(np.repeat(surface_mm[None], frames, axis=0), model)


def made(**changed):
    shared = {"noise_shifts": 0.4, "noise_parts": ((0.3, 0.0), (0.7, 1.6)), "pattern_shifts": 0.1}
    return SensorModel(**{**shared, "pattern_blur_px": 3.0, **changed})


@pytest.fixture(scope="module")
def readings():
    return read(made())


def middle(found):
    return found[1]


def test_noise_is_as_large_and_reaches_as_far_as_it_was_made(readings):
    one = middle(statistics_of(readings))
    step_mm = SLOPE_MM[SLOPE_MM > 700.0].mean() ** 2 / STEPS_A_MM
    freedom = np.sqrt(10 / 12)  # mean and line of twelve readings are taken off
    assert one.deviation_mm == pytest.approx(freedom * np.hypot(0.4, np.sqrt(1 / 12)) * step_mm, rel=0.08)
    expected = [0.7 * np.exp(-(lag**2) / (4 * 1.6**2)) * 0.4**2 / (0.4**2 + 1 / 12) for lag in IN_SPACE]
    assert one.along_rows == pytest.approx(expected, abs=0.06)
    assert one.along_columns == pytest.approx(expected, abs=0.06)
    assert one.in_time == pytest.approx([-1 / 12 - 1 / 12] * 3, abs=0.05)
    assert one.squares_mm[0] == pytest.approx(one.deviation_mm)
    assert list(one.squares_mm[:5]) == sorted(one.squares_mm[:5], reverse=True)


def test_a_surface_that_moves_slowly_is_not_noise(readings):
    moving = readings + 0.1 * np.arange(12, dtype=np.float32)[:, None, None]
    still, moved = (middle(statistics_of(one)) for one in (readings, moving))
    assert moved.along_rows[3] == pytest.approx(still.along_rows[3], abs=0.01)
    assert moved.deviation_mm == pytest.approx(still.deviation_mm, rel=0.03)


@pytest.mark.parametrize("changed", [{"common_locking_shifts": 0.5}, {"locking_shifts": 0.0}])
def test_common_locking_stands_out_on_a_slope(changed):
    assert (middle(statistics_of(read(made(**changed)))).locking_px > 0.04) is ("common_locking_shifts" in changed)


def test_a_fit_finds_the_noise_again(readings, monkeypatch):
    monkeypatch.setattr(sensor_statistics, "ROUNDS", 40)
    done = []
    found = fit_sensor(readings, done.append)
    assert found.noise_shifts == pytest.approx(0.4, rel=0.12)
    assert done == list(range(1, len(done) + 1))
    of_model, of_fit = (middle(statistics_of(read(one))) for one in (made(), found))
    assert of_fit.along_rows == pytest.approx(of_model.along_rows, abs=0.06)


def test_the_table_has_a_column_for_each_sensor(readings):
    found = statistics_of(readings)
    shown = table({"recording": found, "model": found[:1]})
    assert shown.columns == ("depth, mm", "statistic", "recording", "model")
    assert [row[3] is None for row in shown.rows] == [False] * 12 + [True] * 12


@pytest.mark.parametrize(
    ("depth_mm", "field"),
    [(np.zeros((3, 480, 640)), "frames is 3"), (np.zeros((8, 480, 640)), "still pixels is 0")],
)
def test_what_says_nothing_is_refused(depth_mm, field):
    with pytest.raises(InvalidValueError, match=field):
        statistics_of(depth_mm)


def test_the_command_writes_the_table_and_refuses_an_unknown_model(regular_volunteer, tmp_path):
    arguments = ["sensor", str(regular_volunteer / "recording.oni"), "--out", str(tmp_path)]
    ran = CliRunner().invoke(evaluate, [*arguments, "--model", "usual"])
    assert ran.exit_code == 0, ran.output
    assert (tmp_path / "sensor.csv").read_text().startswith('"depth, mm",statistic,recording,usual')
    refused = CliRunner().invoke(evaluate, [*arguments, "--model", "lidar"])
    assert refused.exit_code == 2
    assert "lidar" in refused.stderr
