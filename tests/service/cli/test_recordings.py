import json
import os
import signal
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from engine.capture.oni.reader import describe
from service.cli import app
from tests.support.capture.oni_recordings import write_recording

pytestmark = pytest.mark.alone


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_info_shows_what_a_recording_holds(tmp_path):
    result = run("info", write_recording(tmp_path / "a.oni", frames=9, lost_depth=frozenset({4, 5})))
    assert result.exit_code == 0
    assert result.stderr == ""
    for words in ("64x48", "16zT", "JPEG", "2 in 1 gap", "all pictures decode", "format 1.0.1.0"):
        assert words in result.stdout


def test_info_as_json_states_the_same(tmp_path):
    result = run("info", "--json", write_recording(tmp_path / "a.oni", frames=9))
    document = json.loads(result.stdout)
    assert (document["depth"]["frames"], document["color"]["codec"], document["damage"]) == (9, "JPEG", None)


def test_info_of_a_cut_recording_shows_what_is_left_one_line_and_code_2(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=9)
    path.write_bytes(path.read_bytes()[:-2000])
    result = run("info", path)
    assert result.exit_code == 2
    assert " of 9" in result.stdout
    assert result.stderr.startswith("a.oni: cut at byte")
    assert result.stderr.count("\n") == 1


def test_info_finds_a_picture_that_does_not_decode_unless_quick(tmp_path):
    path = write_recording(tmp_path / "a.oni", frames=2, color_codec="NONE")
    content = bytearray(path.read_bytes())
    at = content.index(b"NIR\0\x0a") + 40  # the first picture's table of depths
    content[at : at + 2] = b"\xff\xff"
    path.write_bytes(content)
    assert run("info", "--quick", path).exit_code == 0
    result = run("info", path)
    assert result.exit_code == 2
    assert result.stderr == "a.oni: depth frame 1: depth picture is cut: " + result.stderr.split("is cut: ")[1]


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89PNG\r\n\x1a\n" + bytes(50), b"version https://git-lfs.github.com/spec/v1\n", None],
    ids=["empty", "png", "lfs", "missing"],
)
@pytest.mark.parametrize("command", ["info", "record"])
def test_what_is_no_recording_gives_one_line_and_code_2(tmp_path, content, command):
    path = tmp_path / "a.oni"
    if content is not None:
        path.write_bytes(content)
    words = [command, path] if command == "info" else [command, "--source", path, "--out", tmp_path / "b.oni"]
    result = run(*words)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("a.oni: ")
    assert result.stderr.count("\n") == 1


def test_record_writes_a_whole_recording_and_states_it(tmp_path):
    source = write_recording(tmp_path / "source.oni", frames=20)
    result = run("record", "--source", source, "--seconds", "0.3", "--out", tmp_path / "out.oni")
    assert result.exit_code == 0, result.output
    assert "index intact" in result.stdout
    assert describe(tmp_path / "out.oni").damage is None


def test_ctrl_c_ends_a_recording_that_is_whole(tmp_path):
    source = write_recording(tmp_path / "source.oni", frames=300)
    script = (
        "import sys; from service.cli import recordings as r; from engine.capture import recorder\n"
        "follow = recorder._follow\n"
        "def reporting(camera, seconds, report, stop):\n"
        "    def reported(progress):\n"
        "        report(progress); print(progress.frames, flush=True)\n"
        "    return follow(camera, seconds, reported, stop)\n"
        "recorder._follow = reporting\n"
        "from service.cli import main; main()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, "record", "--source", source, "--seconds", "60", "--out", tmp_path / "out.oni"],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "1\n"
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert 1 <= describe(tmp_path / "out.oni").depth.frames < 300
