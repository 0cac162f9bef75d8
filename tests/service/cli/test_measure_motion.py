"""`tidegate measure` with named regions, phase lags and meshes: set beside the truth of a virtual volunteer."""

import csv
import functools
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.motion.learning.trainer import TrainingSettings
from engine.motion.named_regions import load_regions, parse_region
from engine.motion.stages.phase_lag import find_lag
from lab.phantom.truth import load_truth
from service.cli import app
from service.cli.measure import command as measure_command

BELLY = [[239.5, 39.5], [239.5, 159.5], [319.5, 159.5], [319.5, 39.5]]  # cells 24 to 31 by 4 to 15 of the truth


def invoke(folder, out, *extra):
    return CliRunner().invoke(app, ["measure", str(folder / "recording.oni"), "--out", str(out), *extra])


@pytest.fixture(scope="module")
def out(regular_volunteer, tmp_path_factory):
    """The folder of one run that asks for everything; the calibration lies beside the recording."""
    folder = tmp_path_factory.mktemp("motion")
    file = folder / "regions.json"
    file.write_text(json.dumps({"schema": "tidegate.regions/1", "regions": [{"name": "belly", "vertices": BELLY}]}))
    wedge = "wedge=20,20;20,180;140,100"
    options = ["--region", wedge, "--regions", str(file), "--mesh", "600,700,5000", "--point", "175,100"]
    # A short lesson, so that most of a short recording is measured: lags need two cycles.
    quick = functools.partial(TrainingSettings, min_frames=60, min_seconds=5.0, min_cycles=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure_command, "TrainingSettings", quick)
        result = invoke(regular_volunteer, folder / "out", *options)
    assert result.exit_code == 0, result.output
    assert f"Calibration: {regular_volunteer / 'calibration.json'}" in result.output.replace("\n", "")
    assert "1 of 3 meshes could not be written" in result.output
    return folder / "out"


@pytest.fixture(scope="module")
def rows(out):
    with (out / "motion.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def truth(regular_volunteer):
    return load_truth(regular_volunteer / "truth.npz")


def column(rows, name):
    return np.array([float(row[name]) if row[name] else np.nan for row in rows])


def measured(rows):
    return np.array([row["state"] == "measuring" for row in rows])


def test_named_regions_are_the_last_columns_in_the_order_given(rows):
    assert list(rows[0])[-3:] == ["p175_100_mm", "wedge_mm", "belly_mm"]
    assert max(abs(float(rows[0][name])) for name in ("wedge_mm", "belly_mm")) < 0.3  # the reference


def test_a_named_region_is_true_to_a_tenth_of_a_millimetre(rows, truth):
    depth_mm = truth.cell_depth_mm[:, 24:32, 4:16].mean(axis=(1, 2))
    is_measured = measured(rows)
    error_mm = column(rows, "belly_mm")[is_measured] + depth_mm[is_measured]
    assert np.abs(error_mm - error_mm.mean()).mean() < 0.1
    assert np.abs(error_mm - error_mm.mean()).max() < 0.5


def test_the_arrays_say_the_same_as_the_table(out, rows):
    with np.load(out / "regions.npz") as arrays:
        assert arrays["named"].tolist() == ["wedge", "belly"]
        assert arrays["named_mm"][:, 1] == pytest.approx(column(rows, "belly_mm"), abs=1e-4, nan_ok=True)
        assert arrays["lag_pairs"].tolist() == [["thorax", "abdomen"], ["wedge", "whole"], ["belly", "whole"]]
        assert arrays["lag_s"].shape == arrays["lag_deg"].shape == arrays["lag_confidence"].shape == (len(rows), 3)
        assert np.isnan(arrays["lag_s"][~measured(rows)]).all()


def test_the_lag_is_that_of_the_true_signals(out, rows, truth):
    with np.load(out / "regions.npz") as arrays:
        lag_s = arrays["lag_s"][:, 0]
    reported = np.flatnonzero(np.isfinite(lag_s))
    assert len(reported) > 60
    start, end = np.flatnonzero(measured(rows))[0], reported[-1] + 1
    seconds = truth.timestamp_us[start:end] / 1e6
    true = find_lag(
        seconds[::3],
        -truth.thorax_depth_mm[start:end:3],
        -truth.abdomen_depth_mm[start:end:3],
        first="thorax",
        second="abdomen",
    )
    assert lag_s[reported[-1]] == pytest.approx(true.lag_s, abs=0.05)


def test_the_summary_reports_what_a_person_would_compute(out, rows):
    summary = json.loads((out / "motion_summary.json").read_text())
    assert summary["schema"] == "tidegate.motion-summary/1"
    whole_mm = column(rows, "whole_mm")
    assert summary["whole_pp_mm"] == pytest.approx(np.nanmax(whole_mm) - np.nanmin(whole_mm), abs=1e-3)
    assert summary["measured"] == measured(rows).sum()
    assert summary["split_rows"] == [174.5, 174.5]
    assert 0.0 < summary["residual_mean_mm"] < summary["residual_max_mm"]
    lag = summary["lags"][0]
    assert (lag["first"], lag["second"]) == ("thorax", "abdomen")
    assert 0.0 < lag["told_share"] < 1.0
    assert lag["lag_deg"] == pytest.approx(360.0 * lag["lag_s"] / lag["period_s"])
    assert lag["note"] == "too little seen yet"


def test_volume_repeats_to_a_few_millilitres(rows, truth):
    is_measured = measured(rows)
    volume_l = column(rows, "volume_l")[is_measured]
    scale, offset = np.polyfit(truth.volume_l[is_measured], volume_l, 1)
    rest_l = volume_l - scale * truth.volume_l[is_measured] - offset
    assert rest_l.std() < 0.004
    assert scale == pytest.approx(1.0, abs=0.04)


def test_a_mesh_is_written_of_each_frame_that_was_measured(out, rows):
    assert sorted(path.name for path in out.glob("mesh_*")) == ["mesh_000600.ply", "mesh_000700.ply"]
    content = (out / "mesh_000700.ply").read_bytes()
    header, body = content.split(b"end_header\n", 1)
    vertices = int(header.split(b"element vertex ")[1].split()[0])
    points = np.frombuffer(body, dtype="<f4", count=3 * vertices).reshape(-1, 3)
    assert 600.0 < points[:, 2].min() < points[:, 2].max() < 1100.0
    assert np.ptp(points[:, 1]) > np.ptp(points[:, 0]) > 100.0


def test_nothing_half_written_is_left(out):
    assert not list(out.glob("*.partial"))
    assert {path.suffix for path in out.iterdir()} == {".csv", ".npz", ".json", ".ply"}


# -- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        (["--region", "belly"], "region is 'belly'"),
        (["--region", "belly=1,2;3"], "NAME=ROW,COL"),
        (["--region", "belly=1,2;3,x;5,6"], "NAME=ROW,COL"),
        (["--region", "Belly=10,10;10,60;60,60"], "a letter first"),
        (["--region", "belly=10,10;60,60;10,60;60,10"], "simple polygon"),
        (["--region", "belly=10,10;10,60;400,60"], "inside the grid"),
        (["--region", "a=10,10;10,60;60,60", "--region", "a=10,10;10,60;60,60"], "names must be unique"),
        (["--split", "100"], "split is '100'"),
        (["--split", "10,100"], "rows 35 to 315"),
        (["--mesh", "one"], "mesh is 'one'"),
        (["--mesh=-1"], "frames from 0"),
        (["--mesh", "1", "--mesh-format", "stl"], "mesh-format is 'stl'"),
        (["--jobs", "65"], "from 0"),
        (["--jobs=-1"], "from 0"),
        (["--regions", "absent.json"], "readable"),
        (["--calibration", "a.json", "--calibration", "b.json"], "given once"),
    ],
)
def test_a_wrong_option_is_one_line_and_exit_2(regular_volunteer, tmp_path, extra, says):
    result = invoke(regular_volunteer, tmp_path / "out", *extra)
    assert result.exit_code == 2
    assert says in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_without_any_calibration_it_states_where_it_looked(regular_volunteer, tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "recording.oni").symlink_to(regular_volunteer / "recording.oni")
    result = invoke(tmp_path / "in", tmp_path / "out")
    assert result.exit_code == 2
    assert "calibration.json" in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


REGION = {"name": "belly", "vertices": BELLY}


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ([], "file"),
        ({"schema": "tidegate.regions/2", "regions": [REGION]}, "schema"),
        ({"schema": "tidegate.regions/1"}, "regions"),
        ({"schema": "tidegate.regions/1", "regions": []}, "1 to 32"),
        ({"schema": "tidegate.regions/1", "regions": [REGION], "extra": 1}, "extra"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"color": "red"}]}, r"regions\[0\]\.color"),
        ({"schema": "tidegate.regions/1", "regions": [REGION, REGION]}, "names must be unique"),
        ({"schema": "tidegate.regions/1", "regions": [{"name": "belly"}]}, "vertices"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"vertices": [[1, 2], [3, 4]]}]}, "3 to 64"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"vertices": [[1], [3, 4], [5, 6]]}]}, "2 numbers"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"vertices": [["1", 2], [3, 4], [5, 6]]}]}, "number"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"name": 7}]}, "name"),
        ({"schema": "tidegate.regions/1", "regions": [REGION | {"name": "whole"}]}, "another name"),
    ],
)
def test_a_wrong_regions_file_is_refused_by_field_value_and_bound(tmp_path, document, says):
    path = tmp_path / "regions.json"
    path.write_text(json.dumps(document))
    with pytest.raises(Exception, match=says) as caught:
        load_regions(path)
    assert caught.value.code == "invalid_value"


def test_a_region_written_out_is_the_region_of_the_file(tmp_path):
    path = tmp_path / "regions.json"
    path.write_text(json.dumps({"schema": "tidegate.regions/1", "regions": [REGION]}))
    text = "belly=" + ";".join(f"{row},{column}" for row, column in BELLY)
    assert load_regions(path) == (parse_region(text),)
