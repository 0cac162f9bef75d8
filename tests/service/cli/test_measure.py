"""`tidegate measure` on virtual volunteers: true, whole, repeatable, and honest about what it could not measure."""

import csv
import json
import re
import shutil
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest

from engine.motion.learning.model_file import load_model
from lab.phantom.truth import load_truth
from tests.support.command_line import invoke, measured

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.verification]


@dataclass(frozen=True)
class Run:
    """A run of the command: what it wrote, beside the truth."""

    rows: list
    truth: object
    out: object
    said: str

    @property
    def measured(self):
        return np.array([row["state"] == "measuring" for row in self.rows])

    def column(self, name):
        return np.array([float(row[name]) if row[name] else np.nan for row in self.rows])

    def error_mm(self, name, depth_mm):
        """Error of a motion column on measured frames, the first of which is the reference."""
        measured = self.measured
        reference = np.flatnonzero(measured)[0]
        return (self.column(name) - (depth_mm[reference] - depth_mm))[measured]


def beside_truth(folder, made):
    return Run(rows=made.rows, truth=load_truth(folder / "truth.npz"), out=made.out, said=made.said)


def run(folder, out, *extra):
    return beside_truth(folder, measured(folder, out, *extra))


@pytest.fixture(scope="module")
def regular(regular_volunteer, measured_twice):
    return beside_truth(regular_volunteer, measured_twice)


@pytest.fixture(scope="module")
def live(regular_volunteer, measured_live):
    return beside_truth(regular_volunteer, measured_live)


@pytest.fixture(scope="module")
def occluded(occlusion_volunteer, tmp_path_factory):
    return run(occlusion_volunteer, tmp_path_factory.mktemp("occluded"), "--window", "whole:-100:2")


def test_every_depth_frame_has_its_row_in_order(regular):
    assert [int(row["frame_index"]) for row in regular.rows] == list(range(len(regular.truth.timestamp_us)))
    assert [int(row["timestamp_us"]) for row in regular.rows] == regular.truth.timestamp_us.tolist()


def check_that_every_frame_is_counted(run):
    """Compare the printed and the written summary with the states in motion.csv."""
    states = Counter(row["state"] for row in run.rows)
    counts = (states["training"], states["measuring"], states["lost"])
    assert sum(counts) == len(run.rows)
    summary = json.loads((run.out / "motion_summary.json").read_text())
    assert (summary["in_training"], summary["measured"], summary["lost"]) == counts
    assert summary["frames"] == len(run.rows)
    printed = re.search(r"(\d+) frames: (\d+) in training \([^)]*\), (\d+) measured, (\d+) lost", run.said)
    assert tuple(map(int, printed.groups())) == (len(run.rows), *counts)
    return counts


def test_the_summary_counts_every_frame(regular, live):
    assert check_that_every_frame_is_counted(regular) == (0, len(regular.rows), 0)
    in_training, _, _ = check_that_every_frame_is_counted(live)
    assert in_training > load_model(live.out / "model.npz").training_frames > 0


def test_the_summary_counts_every_frame_of_a_recording_with_lost_frames(occluded):
    _, _, lost = check_that_every_frame_is_counted(occluded)
    assert lost > 0


def test_the_summary_counts_every_frame_measured_with_a_stored_model(regular_volunteer, measured_with_model):
    in_training, counted, _ = check_that_every_frame_is_counted(beside_truth(regular_volunteer, measured_with_model))
    assert counted > in_training


def test_the_whole_region_is_true_to_0_12_mm(regular):
    truth = regular.truth
    for name, depth_mm in (("whole", truth.whole_depth_mm), ("thorax", truth.thorax_depth_mm)):
        assert np.abs(regular.error_mm(f"{name}_mm", depth_mm)).mean() < 0.12
    assert np.abs(regular.error_mm("abdomen_mm", truth.abdomen_depth_mm)).mean() < 0.2


def test_five_points_are_true_to_0_35_mm_in_the_mean(regular):
    truth = regular.truth
    errors = [
        np.abs(regular.error_mm(f"p{row}_{column}_mm", truth.point_depth_mm[:, i]))
        for i, (row, column) in enumerate(truth.point_rc)
    ]
    assert np.mean(errors) < 0.35
    assert np.max(errors) < 1.5


def test_the_volume_follows_the_true_volume(regular):
    measured = regular.measured
    volume, truth = regular.column("volume_l")[measured], regular.truth.volume_l[measured]
    assert np.corrcoef(volume, truth)[0, 1] > 0.995
    assert np.polyfit(truth, volume, 1)[0] == pytest.approx(1.0, abs=0.05)


def test_nothing_is_measured_while_training_and_nothing_is_zero(live):
    first = live.rows[0]
    assert first["state"] == "training"
    assert {first[name] for name in ("whole_mm", "thorax_mm", "abdomen_mm", "volume_l")} == {""}
    assert live.rows[-1]["state"] == "measuring"


def test_the_offline_gate_is_on_only_inside_its_window_and_after_a_dwell(regular):
    on = np.array([row["gate"] == "beam_on" for row in regular.rows])
    assert on.any()
    assert not on[: np.flatnonzero(regular.measured)[0] + 3].any()
    whole = regular.column("whole_mm")[on]
    assert whole.min() >= -1.0
    assert whole.max() <= 3.0
    assert {row["hold_reason"] for row in regular.rows if row["gate"] == "beam_on"} == {""}


def test_region_and_model_files_say_the_same_as_the_table(regular):
    with np.load(regular.out / "regions.npz") as regions:
        assert regions["motion_mm"].shape == (len(regular.rows), 14, 8)
        assert np.isnan(regions["motion_mm"][~regular.measured]).all()
        seen = regions["seen"]
        assert seen.shape == (len(regular.rows), 14, 8)
        assert np.isnan(seen[~regular.measured]).all()
        assert 0.9 < seen[regular.measured].mean() <= seen[regular.measured].max() <= 1.0
        mean = np.nanmean(regions["motion_mm"][regular.measured], axis=(1, 2))
    assert np.abs(mean - regular.column("whole_mm")[regular.measured]).max() < 0.2
    model = load_model(regular.out / "model.npz")
    assert model.cycles >= 3
    assert model.spectrum[:3].sum() > 0.9


def test_the_same_recording_gives_the_same_bytes(regular_volunteer, regular, regular_options, tmp_path):
    run(regular_volunteer, tmp_path, *regular_options)
    for name in ("motion.csv", "model.npz"):
        assert (tmp_path / name).read_bytes() == (regular.out / name).read_bytes(), name


def test_cells_of_ten_pixels_are_35_rows_of_20(regular_volunteer, tmp_path):
    fine = run(regular_volunteer, tmp_path, "--cell", "10", "--single-pass")
    with np.load(tmp_path / "regions.npz") as regions:
        motion = regions["motion_mm"]
    measured = fine.measured
    reference = np.flatnonzero(measured)[0]
    truth = fine.truth.cell_depth_mm[reference] - fine.truth.cell_depth_mm
    assert motion.shape == (len(fine.rows), 35, 20)
    assert np.nanmean(np.abs(motion - truth)[measured]) < 0.25


def test_a_deep_breath_hold_is_not_shown_at_half_its_size(dibh_volunteer, measured_hold):
    held = beside_truth(dibh_volunteer, measured_hold)
    assert np.ptp(held.truth.whole_depth_mm[held.measured]) > 10.0
    assert np.abs(held.error_mm("whole_mm", held.truth.whole_depth_mm)).max() < 0.5


def event(truth, name):
    return next(e for e in truth.events if e["name"] == name)


def during(occluded, name, margin_us=300_000):
    found = event(occluded.truth, name)
    times = occluded.truth.timestamp_us
    return (times > found["start_us"] + margin_us) & (times < found["end_us"] - margin_us)


def test_a_hidden_marker_is_lost_and_holds(occluded):
    hidden = during(occluded, "marker_hidden")
    assert {row["state"] for row, at in zip(occluded.rows, hidden, strict=True) if at} == {"lost"}
    assert "beam_on" not in {row["gate"] for row, at in zip(occluded.rows, hidden, strict=True) if at}


def test_a_hand_never_makes_a_wrong_number(occluded):
    assert np.abs(occluded.error_mm("whole_mm", occluded.truth.whole_depth_mm)).max() < 0.5
    over_the_region = during(occluded, "hand", margin_us=1_500_000)  # it takes over a second to get there
    rows = [row for row, at in zip(occluded.rows, over_the_region, strict=True) if at]
    assert {row["state"] for row in rows} == {"lost"}
    assert "beam_on" not in {row["gate"] for row in rows}


def test_after_the_hand_and_the_marker_are_back_the_gate_may_be_on_again(occluded):
    ended_us = max(event(occluded.truth, name)["end_us"] for name in ("hand", "marker_hidden"))
    after = [row for row in occluded.rows if int(row["timestamp_us"]) > ended_us]
    assert after[-1]["state"] == "measuring"
    assert "beam_on" in {row["gate"] for row in after}


@pytest.mark.parametrize(
    ("extra", "names"),
    [
        (["--cell", "3"], "cell"),
        (["--point", "400,10"], "point"),
        (["--point", "ten"], "point"),
        (["--head", "north"], "head"),
        (["--window", "whole:3:-1"], "upper_mm"),
        (["--window", "belly:0:1"], "signal"),
        (["--window", "whole:a:b"], "window"),
        (["--components", "0"], "components"),
    ],
)
def test_a_wrong_option_is_one_line_and_exit_2(regular_volunteer, tmp_path, extra, names):
    out = tmp_path / "out"
    result = invoke(regular_volunteer, out, *extra)
    assert result.exit_code == 2
    assert names in result.output
    assert "Traceback" not in result.output
    assert not out.exists()


def test_a_wrong_calibration_is_named_and_nothing_is_written(regular_volunteer, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(regular_volunteer, folder, ignore=shutil.ignore_patterns("truth.npz"))
    document = json.loads((folder / "calibration.json").read_text())
    document["depth"]["fx"] = 1.0
    (folder / "calibration.json").write_text(json.dumps(document))
    result = invoke(folder, tmp_path / "out")
    assert result.exit_code == 2
    assert "depth.fx is 1.0" in result.output
    assert not (tmp_path / "out").exists()


def test_a_calibration_of_another_picture_size_is_refused(regular_volunteer, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(regular_volunteer, folder, ignore=shutil.ignore_patterns("truth.npz"))
    document = json.loads((folder / "calibration.json").read_text())
    document["color"].update(width=1280, height=1024, fx=1060.0, fy=1060.0, distortion=[0.0] * 5)
    (folder / "calibration.json").write_text(json.dumps(document))
    result = invoke(folder, tmp_path / "out")
    assert result.exit_code == 2
    assert "color.width" in result.output
    assert "1280" in result.output


def test_a_cut_recording_keeps_what_was_readable_and_states_it(regular_volunteer, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    whole = (regular_volunteer / "recording.oni").read_bytes()
    (folder / "recording.oni").write_bytes(whole[: int(0.7 * len(whole))])
    shutil.copy(regular_volunteer / "calibration.json", folder)
    result = invoke(folder, tmp_path / "out")
    assert result.exit_code == 2
    assert "Traceback" not in result.output
    with (tmp_path / "out" / "motion.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert 400 < len(rows) < 560
    assert rows[-1]["state"] == "measuring"


def test_the_breath_has_a_row_for_every_frame_and_nothing_where_nothing_is_known(regular):
    with (regular.out / "breathing.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("frame_index", "timestamp_us", "phase_percent", "phase_confidence", "rate_per_min", "amplitude_mm"),
        *("baseline_mm", "drift_mm", "drift_mm_s", "regularity", "events"),
    ]
    assert [row["frame_index"] for row in rows] == [row["frame_index"] for row in regular.rows]
    assert [row["timestamp_us"] for row in rows] == [row["timestamp_us"] for row in regular.rows]
    assert set(list(rows[0].values())[2:]) == {""}
    assert all(0.0 <= float(row["phase_percent"]) < 100.0 for row in rows if row["phase_percent"])
    assert float(rows[-1]["rate_per_min"]) == pytest.approx(15.0, rel=0.1)
    assert {row["events"] for row in rows} == {""}


def test_a_recording_too_short_to_learn_from_states_why(regular_volunteer, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    whole = (regular_volunteer / "recording.oni").read_bytes()
    (folder / "recording.oni").write_bytes(whole[: int(0.2 * len(whole))])
    shutil.copy(regular_volunteer / "calibration.json", folder)
    result = invoke(folder, tmp_path / "out")
    assert result.exit_code == 2
    assert "breathing cycles" in result.output
    assert (tmp_path / "out" / "motion.csv").exists()
    assert (tmp_path / "out" / "breathing.csv").exists()
    assert not list((tmp_path / "out").glob("*.partial"))


@pytest.mark.parametrize(
    ("content", "says"), [(None, "recording.oni"), (b"", "empty"), (b"\x89PNG\r\n", "recording.oni")]
)
def test_what_is_no_recording_is_one_line_and_leaves_nothing(regular_volunteer, tmp_path, content, says):
    folder = tmp_path / "in"
    folder.mkdir()
    if content is not None:
        shutil.copy(regular_volunteer / "calibration.json", folder)
        (folder / "recording.oni").write_bytes(content)
    result = invoke(folder, tmp_path / "out")
    assert result.exit_code == 2
    assert says in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_stated_so(regular_volunteer, tmp_path):
    (tmp_path / "out").write_text("a file is in the way")
    result = invoke(regular_volunteer, tmp_path / "out")
    assert result.exit_code == 2
    assert "cannot be written" in result.output
