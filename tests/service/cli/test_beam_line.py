"""``tidegate beam-line check``: what it measures, what it refuses, and that it never leaves a line on."""

import threading

import pytest
from typer.testing import CliRunner

from engine.beam.commissioning import PULSE_BOUNDS_MS
from service.cli import app
from tests.support.beam.receivers import TIMES, receiver
from tests.support.site_settings import give_settings

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_settings_around")]

SAFE = "--yes-the-beam-is-safe"
TRIES = 6


def run(*arguments):
    return CliRunner().invoke(app, ["beam-line", "check", *arguments])


@pytest.mark.parametrize("pulse_ms", [0.0, 19.9, 200.1, -60.0, float("nan"), float("inf")])
def test_a_pulse_longer_than_any_lease_or_too_short_is_refused(pulse_ms):
    refused = run("--pulse", str(pulse_ms), SAFE)
    assert refused.exit_code == 2
    assert f"from {PULSE_BOUNDS_MS[0]:g} to {PULSE_BOUNDS_MS[1]:g} ms" in refused.stderr


def test_a_pulse_without_the_word_that_the_beam_is_safe_is_refused_and_nothing_is_opened(monkeypatch, tmp_path):
    with receiver("tcp") as far:
        _point_at(monkeypatch, tmp_path, far)
        refused = run("--pulse", "60")
        assert refused.exit_code == 2
        assert refused.stdout == ""
        assert refused.stderr.count("\n") == 1
        assert SAFE in refused.stderr
    assert far.seen == []


@pytest.mark.parametrize("repeats", ["0", "1001", "many"])
def test_the_number_of_pulses_is_bounded(repeats):
    assert run("--pulse", "60", SAFE, "--repeats", repeats).exit_code == 2


def _point_at(monkeypatch, tmp_path, far):
    names = {
        "LINE": "modbus-tcp",
        "MODBUS_HOST": "127.0.0.1",
        "MODBUS_PORT": far.where,
        "MODBUS_UNIT": "7",
        "MODBUS_PERMIT_COIL": "3",
        "MODBUS_HEARTBEAT_REGISTER": "11",
        "MODBUS_READBACK_INPUT": "5",
        "ANSWER_MS": f"{TIMES.answer_ms:g}",
        "SETTLE_MS": f"{TIMES.settle_ms:g}",
    }
    give_settings(monkeypatch, tmp_path, **{f"beam_{name.lower()}": value for name, value in names.items()})


def _checked(monkeypatch, tmp_path, *arguments):
    """Check a receiver; another one where a busy machine answered late. Return what was said and what it saw."""
    monkeypatch.setattr("service.cli.beam_line.WATCHED_S", 0.2)
    for _ in range(TRIES):
        with receiver("tcp") as far:
            _point_at(monkeypatch, tmp_path, far)
            done = run(*arguments)
        if done.exit_code == 0:
            break
    assert done.exit_code == 0, done.stderr
    return done, far.seen


def test_a_line_is_opened_read_and_timed_and_never_permitted(monkeypatch, tmp_path):
    done, seen = _checked(monkeypatch, tmp_path)
    assert seen == []
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("tidegate-beam")]
    assert "modbus-tcp: request -> answer" in done.stdout
    assert "permit ->" not in done.stdout


def test_pulses_are_what_the_receiver_sees(monkeypatch, tmp_path):
    monkeypatch.setenv("TIDEGATE_BEAM_SECOND_INPUT", "readback")
    done, seen = _checked(monkeypatch, tmp_path, "--pulse", "150", SAFE, "--repeats", "3")
    assert [edge[0] for edge in seen] == ["on", "off"] * 9
    assert [edge[2] for edge in seen[1::2]] == ["command"] * 6 + ["heartbeat"] * 3
    assert [row.split("│")[1].strip() for row in done.stdout.splitlines() if "->" in row][1:] == ["6", "3", "3", "3"]


def test_a_simulated_line_is_checked_too():
    done = run("--pulse", "60", SAFE, "--repeats", "1")
    assert done.exit_code == 0
    assert "simulated: open, reads off" in done.stderr
    assert "simulated: last heartbeat -> contact open" in done.stdout


def _failed(monkeypatch, tmp_path, second_input, spoilt, says):
    """Check a receiver that is to fail; another one where a busy machine kept the check from its end."""
    monkeypatch.setattr("service.cli.beam_line.WATCHED_S", 0.2)
    for _ in range(TRIES):
        with receiver("tcp") as far:
            _point_at(monkeypatch, tmp_path, far)
            if second_input:
                monkeypatch.setenv("TIDEGATE_BEAM_SECOND_INPUT", second_input.format(port=far.where))
            if spoilt:
                far.spoil(spoilt)
            done = run("--pulse", "200", SAFE, "--repeats", "1")
        if done.exit_code == 1 and says in done.stderr:
            break
    return done


@pytest.mark.parametrize("second_input", ["readback", "127.0.0.1:{port}/7/5"], ids=["read-back", "another connection"])
def test_a_receiver_without_the_heartbeat_s_rule_fails_the_check_in_one_line(monkeypatch, tmp_path, second_input):
    says = "drill of the heartbeat: modbus-tcp: the contact stayed closed for 500 ms after the heartbeat stood still"
    failed = _failed(monkeypatch, tmp_path, second_input, "keeps", says)
    assert (failed.exit_code, failed.stderr.splitlines()[-1]) == (1, f"tidegate beam-line check: failed: {says}")
    assert "hold -> read back off" in failed.stdout


def test_a_receiver_that_takes_the_old_permit_again_fails_the_check(monkeypatch, tmp_path):
    says = "the contact closed again with the next heartbeats, though the permit had not been withdrawn once"
    assert _failed(monkeypatch, tmp_path, "readback", "recloses", says).stderr.splitlines()[-1].endswith(says)


def test_a_line_without_a_second_input_is_not_verifiable_and_does_not_pass(monkeypatch, tmp_path):
    says = "drill of the heartbeat: modbus-tcp: not verifiable: no second input configured"
    failed = _failed(monkeypatch, tmp_path, None, None, says)
    assert (failed.exit_code, failed.stderr.splitlines()[-1]) == (1, f"tidegate beam-line check: failed: {says}")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"TIDEGATE_BEAM_LINE": "modbus-tcp", "TIDEGATE_BEAM_MODBUS_HOST": "127.0.0.1"}, "does not answer"),
        ({"TIDEGATE_BEAM_LINE": "none"}, "TIDEGATE_BEAM_LINE"),
    ],
    ids=["nobody there", "no such line"],
)
def test_a_line_that_is_not_there_is_refused_in_one_line(monkeypatch, names, said):
    for name, value in names.items():
        monkeypatch.setenv(name, value)
    if "TIDEGATE_BEAM_MODBUS_HOST" in names:
        monkeypatch.setenv("TIDEGATE_BEAM_MODBUS_PORT", "1")
    refused = run()
    assert refused.exit_code == 2
    assert refused.stderr.count("\n") == 1
    assert refused.stderr.startswith("tidegate beam-line check: ")
    assert said in refused.stderr


def test_a_receiver_that_fails_under_pulses_ends_in_one_line_and_off(monkeypatch, tmp_path):
    monkeypatch.setattr("service.cli.beam_line.WATCHED_S", 0.2)
    for _ in range(TRIES):
        with receiver("tcp") as far:
            _point_at(monkeypatch, tmp_path, far)
            far.spoil("stuck off")
            refused = run("--pulse", "200", SAFE, "--repeats", "1")
            assert refused.exit_code == 2
            assert refused.stderr.splitlines()[-1].startswith("tidegate beam-line check: ")
        if far.seen:  # else a busy machine did not come as far as to permit
            break
    assert [edge[0] for edge in far.seen] == ["on", "off"]
