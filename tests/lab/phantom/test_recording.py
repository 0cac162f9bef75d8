import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.calibration.camera_calibration import load_calibration
from engine.capture.oni.reader import OniReader
from engine.core.errors import InvalidValueError, RecordingError
from lab.phantom import recording
from lab.phantom.builds import find_build
from lab.phantom.recording import FILES, load_truth, make_volunteer
from lab.phantom.rig import build_rig
from service.cli import app
from tests.support.repository import DATA

pytestmark = [pytest.mark.long, pytest.mark.slow]

SHORT = {"volunteer": 6, "seconds": 2.1, "seed": 5}
TINY = {**SHORT, "fps": 5.0}


@pytest.fixture(scope="module")
def progress():
    return []


@pytest.fixture(scope="module")
def short(tmp_path_factory, progress):
    folder = tmp_path_factory.mktemp("short") / "one"
    note = progress.append
    make_volunteer("regular", **SHORT, out=folder, workers=1, on_progress=lambda done, total: note((done, total)))
    return folder


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny") / "one"
    make_volunteer("regular", **TINY, out=folder, workers=1)
    return folder


def frames_of(folder):
    with OniReader(folder / "recording.oni") as reader:
        frames = list(reader.frames())
    return [f for f in frames if f.is_depth], [f for f in frames if not f.is_depth], frames


def test_same_seed_same_recording_with_one_process_and_with_two(tiny, tmp_path):
    """Not byte by byte: a process of its own has another number of native threads, which divide a picture otherwise."""
    two = tmp_path / "two"
    make_volunteer("regular", **TINY, out=two, workers=2)
    pairs = list(zip(frames_of(tiny)[2], frames_of(two)[2], strict=True))
    assert [one.timestamp_us for one, _ in pairs] == [other.timestamp_us for _, other in pairs]
    for one, other in pairs:
        pictures = [(frame.decode_depth() if frame.is_depth else frame.decode_color()) for frame in (one, other)]
        assert np.mean(pictures[0] != pictures[1]) < 1e-3, "a reading may round to the sensor's next step"
    truths = [np.load(folder / "truth.npz") for folder in (tiny, two)]
    for name in truths[0].files:
        one, other = (truth[name] for truth in truths)
        if one.dtype.kind == "f":
            assert np.allclose(one, other, rtol=0.0, atol=1e-3, equal_nan=True), name
        else:
            assert np.array_equal(one, other), name
    assert (two / "calibration.json").read_bytes() == (tiny / "calibration.json").read_bytes()


def test_another_seed_gives_other_noise_and_another_breath(tiny, tmp_path):
    make_volunteer("regular", **{**TINY, "seed": 6}, out=tmp_path / "b", workers=1)
    one, other = load_truth(tiny / "truth.npz"), load_truth(tmp_path / "b" / "truth.npz")
    assert np.abs(one.whole_depth_mm - other.whole_depth_mm).max() > 0.1
    assert frames_of(tiny)[0][0].payload != frames_of(tmp_path / "b")[0][0].payload
    assert (tiny / "calibration.json").read_bytes() == (tmp_path / "b" / "calibration.json").read_bytes()


def test_the_folder_holds_its_four_files_and_nothing_beside(short):
    assert sorted(path.name for path in short.iterdir()) == sorted(FILES)
    assert [path.name for path in short.parent.iterdir()] == ["one"]


def test_truth_has_a_row_for_every_frame_of_the_recording(short):
    truth = load_truth(short / "truth.npz")
    depth, color, _ = frames_of(short)
    assert truth.timestamp_us.tolist() == [frame.timestamp_us for frame in depth]
    assert truth.color_timestamp_us.tolist() == [frame.timestamp_us for frame in color]
    n, m = len(depth), len(color)
    assert truth.cell_depth_mm.shape == (n, 35, 20)
    assert truth.point_depth_mm.shape == (n, 5)
    assert truth.markers_px.shape == (m, 4, 2)
    assert truth.depth_markers_px.shape == (n, 4, 2)
    assert truth.full_depth_mm.shape == (len(truth.full_index), 350, 200)
    for name in ("whole_depth_mm", "thorax_depth_mm", "abdomen_depth_mm", "volume_l"):
        assert getattr(truth, name).shape == (n,)
    assert truth.volume_l[0] == 0.0
    assert truth.whole_depth_mm == pytest.approx((truth.thorax_depth_mm + truth.abdomen_depth_mm) / 2)
    assert truth.full_depth_mm.mean(axis=(1, 2)) == pytest.approx(truth.whole_depth_mm[truth.full_index], abs=1e-3)
    assert truth.trace_mm.shape == (len(truth.trace_s), 2)


def test_frames_come_in_order_of_time_at_2997_a_second_with_jitter(short):
    depth, color, frames = frames_of(short)
    stamps = [frame.timestamp_us for frame in frames]
    assert stamps == sorted(stamps)
    for stream in (depth, color):
        steps = np.diff([frame.timestamp_us for frame in stream])
        assert steps.mean() == pytest.approx(33_367, abs=60)
        assert 60 < steps.std() < 600
        assert [frame.frame_id for frame in stream] == list(range(1, len(stream) + 1))
        assert all(frame.missed_frames == 0 for frame in stream)


def test_colour_drifts_in_phase_against_depth(regular_volunteer):
    truth = load_truth(regular_volunteer / "truth.npz")
    count = min(len(truth.timestamp_us), len(truth.color_timestamp_us))
    gap = truth.color_timestamp_us[:count] - truth.timestamp_us[:count]
    assert gap[-30:].mean() - gap[:30].mean() > 10_000


def test_the_calibration_is_that_of_the_rig_and_undoes_the_quantisation(short):
    calibration = load_calibration(short / "calibration.json")
    rig = build_rig(find_build(6), 6)
    assert calibration.sha256 == rig.calibration.sha256
    assert np.linalg.norm(calibration.color_from_depth.translation_mm) == pytest.approx(25.0, abs=0.2)
    disparity, focal = calibration.disparity, calibration.depth.fx
    # Two neighbouring readings at 850 mm are one step of disparity apart.
    step_mm = 850.0**2 * disparity.step_px / (focal * disparity.baseline_mm)
    assert step_mm == pytest.approx(2.11, abs=0.05)


@pytest.mark.parametrize("scenario", ["regular_volunteer", "dibh_volunteer", "occlusion_volunteer"])
def test_breathing_lifts_the_skin_by_millimetres_and_decilitres(scenario, request):
    truth = load_truth(request.getfixturevalue(scenario) / "truth.npz")
    free = truth.timestamp_us < 20_000_000
    motion = truth.whole_depth_mm[0] - truth.whole_depth_mm
    assert 3.0 < np.ptp(motion[free]) < 12.0
    assert 0.2 < np.ptp(truth.volume_l[free]) < 1.2
    assert np.corrcoef(motion[free], truth.volume_l[free])[0, 1] > 0.98
    assert np.ptp(truth.abdomen_depth_mm[free]) > 1.3 * np.ptp(truth.thorax_depth_mm[free])


def test_the_recording_shows_the_true_depth_of_the_region(regular_volunteer):
    truth = load_truth(regular_volunteer / "truth.npz")
    correction = load_calibration(regular_volunteer / "calibration.json").depth_correction
    depth, _, _ = frames_of(regular_volunteer)
    means = []
    picks = np.arange(0, len(depth), 24)
    for index in picks:
        patch = depth[index].decode_depth()[200:300, 310:370].astype(float)
        means.append(correction.scale * patch[patch > 0].mean() + correction.offset_mm)
    middle = truth.cell_depth_mm[picks][:, 10:24, 5:14].mean(axis=(1, 2))
    assert np.corrcoef(means, middle)[0, 1] > 0.995
    assert np.abs(np.array(means) - middle).max() < 8.0


def test_a_hold_is_two_to_three_times_as_high_and_more_of_it_chest(dibh_volunteer):
    truth = load_truth(dibh_volunteer / "truth.npz")
    (hold,) = [event for event in truth.events if event["name"] == "hold"]
    free = truth.timestamp_us < 20_000_000
    held = (truth.timestamp_us > hold["start_us"] + 700_000) & (truth.timestamp_us < hold["end_us"])
    assert hold["end_us"] - hold["start_us"] >= 10_000_000

    def height(depth):
        rest = depth[free].max()
        return (rest - depth[held].mean()) / (rest - depth[free].min())

    assert 1.8 < height(truth.whole_depth_mm) < 3.3
    assert height(truth.thorax_depth_mm) > 1.2 * height(truth.abdomen_depth_mm)
    assert truth.whole_depth_mm[held].std() < 0.5


def test_a_hand_hides_the_region_and_the_truth_goes_on_beneath(occlusion_volunteer):
    truth = load_truth(occlusion_volunteer / "truth.npz")
    (hand,) = [event for event in truth.events if event["name"] == "hand"]
    depth, _, _ = frames_of(occlusion_volunteer)

    def nearest_mm(time_us):
        index = int(np.searchsorted(truth.timestamp_us, time_us))
        picture = depth[index].decode_depth()[180:330, 290:390]
        return np.percentile(picture[picture > 0], 2)

    middle = (hand["start_us"] + hand["end_us"]) // 2
    assert nearest_mm(middle) < nearest_mm(hand["start_us"] - 1_000_000) - 150
    assert nearest_mm(hand["end_us"] + 1_000_000) > nearest_mm(middle) + 150
    assert np.abs(np.diff(truth.whole_depth_mm)).max() < 1.0


def test_the_hidden_sticker_is_hidden_and_the_others_are_not(occlusion_volunteer):
    truth = load_truth(occlusion_volunteer / "truth.npz")
    (event,) = [event for event in truth.events if event["name"] == "marker_hidden"]
    _, color, _ = frames_of(occlusion_volunteer)

    def brightness(time_us):
        index = int(np.searchsorted(truth.color_timestamp_us, time_us))
        picture = color[index].decode_color().mean(axis=2)
        return np.array([picture[y, x] for x, y in np.rint(truth.markers_px[index]).astype(int)])

    assert brightness(event["start_us"] - 500_000).min() > 150
    during = brightness((event["start_us"] + event["end_us"]) // 2)
    assert list(np.flatnonzero(during < 120)) == [int(event["detail"]["marker"])]
    assert brightness(event["end_us"] + 500_000).min() > 150


def test_after_a_shift_the_stickers_lie_elsewhere(studio):
    scene = studio("shift", 8).scene
    move = scene.timeline.events[1]
    before, after = scene.markers_px(move.start_s - 0.01), scene.markers_px(move.end_s + 0.01)
    assert np.linalg.norm(after - before, axis=1).min() > 1.0
    sides = [np.roll(corners, 1, axis=0) - corners for corners in (before, after)]
    lengths = [np.linalg.norm(side, axis=1) for side in sides]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.02)
    turned = np.degrees(np.arctan2(sides[1][1, 1], sides[1][1, 0]) - np.arctan2(sides[0][1, 1], sides[0][1, 0]))
    assert turned == pytest.approx(move.detail["turn_deg"], abs=0.3)
    # The middle of the four moves as the couch frame's axes lie in the picture: x to the right, y down.
    moved_mm = (after - before).mean(axis=0) * 920.0 / scene.rig.color.fx
    assert moved_mm == pytest.approx([move.detail["x_mm"], move.detail["y_mm"]], abs=1.5)


def test_a_trace_file_drives_a_volunteer(tmp_path):
    out = tmp_path / "t"
    trace = DATA / "qa" / "LiverTraj_LargeSIandAP70s_robot.txt"
    make_volunteer("regular", volunteer=2, seconds=4.0, fps=8.0, seed=1, out=out, trace=trace, workers=1)
    truth = load_truth(out / "truth.npz")
    labels = json.loads(truth.labels)
    assert (labels["trace_kind"], labels["scenario"], labels["volunteer"]) == ("qa", "regular", 2)
    driven = np.interp(truth.timestamp_us * 1e-6, truth.trace_s, truth.trace_mm[:, 0])
    assert np.ptp(driven) > 4.0
    lagged = np.interp(truth.timestamp_us * 1e-6 - 0.15, truth.trace_s, truth.trace_mm[:, 0])
    assert np.corrcoef(lagged, -truth.abdomen_depth_mm)[0, 1] > 0.98


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"volunteer": 11}, "volunteer"),
        ({"volunteer": 1.5}, "volunteer"),
        ({"seconds": 1.0}, "seconds"),
        ({"seconds": float("nan")}, "seconds"),
        ({"seconds": "10"}, "seconds"),
        ({"fps": 0.0}, "fps"),
        ({"fps": 61.0}, "fps"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**32}, "seed"),
        ({"seed": 1.0}, "seed"),
        ({"workers": 0}, "workers"),
    ],
)
def test_a_bad_argument_is_named_with_its_bound_and_leaves_nothing(tmp_path, changes, field):
    arguments = {"volunteer": 1, "seconds": 5.0, "seed": 1, **changes}
    with pytest.raises(InvalidValueError) as caught:
        make_volunteer("regular", **arguments, out=tmp_path / "deep" / "x")
    assert caught.value.field == field
    assert list(tmp_path.iterdir()) == []


def test_what_stops_half_way_leaves_nothing_half_written(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_volunteer(
            "regular", volunteer=1, seconds=2.0, fps=5.0, seed=1, out=tmp_path / "x", workers=1, on_progress=stop
        )
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_every_frame_once(short, progress):
    total = len(frames_of(short)[0])
    assert progress[-1] == (total, total)
    assert len(progress) > 1
    assert [done for done, _ in progress] == sorted({done for done, _ in progress})


def test_a_volunteer_made_again_replaces_the_files_and_nothing_else(tiny, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(tiny, out)
    (out / "recording.oni").write_bytes(b"old")
    (out / "notes.txt").write_text("mine")
    make_volunteer("regular", **TINY, out=out, workers=1)
    assert (out / "recording.oni").read_bytes() == (tiny / "recording.oni").read_bytes()
    assert (out / "notes.txt").read_text() == "mine"
    (tmp_path / "file").write_text("x")
    with pytest.raises(InvalidValueError, match=r"out is .*: must be a folder"):
        make_volunteer("regular", **TINY, out=tmp_path / "file", workers=1)


def test_a_killed_process_is_one_clear_line(tmp_path, monkeypatch):
    def killed(script, tasks, workers):
        raise recording.BrokenProcessPool
        yield

    monkeypatch.setattr(recording, "_make_all", killed)
    with pytest.raises(RecordingError, match="a process that made frames was killed"):
        make_volunteer("regular", **SHORT, out=tmp_path / "x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["dance", "--volunteer", "1"], "scenario is 'dance': must be one of regular"),
        (["dibh", "--seconds", "20"], "seconds is 20.0: must be from 36"),
        (["regular", "--volunteer", "12"], "volunteer is 12: must be a whole number from 1 to 10"),
        (["regular", "--trace", "missing.vxp"], "missing.vxp: cannot be read"),
    ],
)
def test_the_command_refuses_in_one_line_with_exit_code_2(tmp_path, arguments, words):
    outcome = CliRunner().invoke(app, ["phantom", *arguments, "--out", str(tmp_path / "x")])
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert len(outcome.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_the_command_makes_a_volunteer(tiny, tmp_path):
    arguments = ["--volunteer", "6", "--seconds", "2.1", "--seed", "5", "--fps", "5", "--workers", "1"]
    outcome = CliRunner().invoke(app, ["phantom", "regular", *arguments, "--out", str(tmp_path / "x")])
    assert outcome.exit_code == 0, outcome.stderr
    assert (tmp_path / "x" / "recording.oni").read_bytes() == (tiny / "recording.oni").read_bytes()
