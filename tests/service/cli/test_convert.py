"""``tidegate convert``: what it prints, and its exit codes."""

import pytest
from typer.testing import CliRunner

from engine.capture.oni.reader import OniReader
from service.cli import app


def called(*words):
    return CliRunner().invoke(app, ["convert", *map(str, words)])


def test_a_volunteer_s_recording_goes_to_mcap_and_back(regular_volunteer, tmp_path):
    done = called(
        regular_volunteer / "recording.oni",
        tmp_path / "a.mcap",
        "--calibration",
        regular_volunteer / "calibration.json",
    )
    assert done.exit_code == 0, done.output
    assert "camera unknown" in done.output
    assert called(tmp_path / "a.mcap", tmp_path / "b.oni").exit_code == 0
    with OniReader(regular_volunteer / "recording.oni") as one, OniReader(tmp_path / "b.oni") as other:
        pairs = zip(one.frames(), other.frames(), strict=True)
        assert all((a.timestamp_us, a.frame_id, a.payload) == (b.timestamp_us, b.frame_id, b.payload) for a, b in pairs)


def test_a_recording_that_is_cut_off_is_converted_and_said(regular_volunteer, tmp_path):
    raw = (regular_volunteer / "recording.oni").read_bytes()
    (tmp_path / "cut.oni").write_bytes(raw[: len(raw) // 10])
    done = called(tmp_path / "cut.oni", tmp_path / "a.mcap")
    assert done.exit_code == 2
    assert "what comes before is converted" in " ".join(done.output.split())
    assert (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("absent.oni", "a.mcap"), "cannot be opened"),
        (("absent.bag", "a.mcap"), "source"),
        (("recording.oni", "a.bag"), "target"),
        (("recording.oni", "a.mcap", "--calibration", "absent.json"), "absent.json"),
        (("recording.oni", "nowhere/a.mcap"), "nowhere"),
    ],
)
def test_what_cannot_be_converted_is_refused_in_one_line(regular_volunteer, tmp_path, words, said):
    place = {"recording.oni": regular_volunteer / "recording.oni"}
    done = called(*(place.get(word, word if word.startswith("--") else tmp_path / word) for word in words))
    assert done.exit_code == 2
    assert said in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
