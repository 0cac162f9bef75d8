"""Which line a site uses: named by its settings, bounded, and never a simulation where it must not be one."""

import os
import subprocess
import sys

import pytest

from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.beam.status.published_line import PublishedBeamLine
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import MonotonicClock
from service.core.settings.beam import USED_BY, BeamSettings
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.beam_lines import make_beam_line
from service.engine_host.local_engine import LocalEngine
from tests.support.beam.receivers import receiver
from tests.support.service.clinical_site import OBLIGATORY, environment

TCP = {"BEAM_LINE": "modbus-tcp", "BEAM_MODBUS_HOST": "127.0.0.1"}
RTU = {"BEAM_LINE": "modbus-rtu", "BEAM_RTU_DEVICE": "/dev/ttyUSB0"}
RELAY = {"BEAM_LINE": "serial-relay", "BEAM_RELAY_DEVICE": "/dev/ttyUSB1"}
CLINICAL = environment({"mode": "clinical", **OBLIGATORY, "hardware_dead_man": True})


@pytest.fixture(autouse=True)
def no_settings_around(monkeypatch):
    for name in list(os.environ):
        if name.startswith("TIDEGATE_"):
            monkeypatch.delenv(name)


@pytest.fixture
def site(monkeypatch):
    def load(**names):
        for name, value in names.items():
            monkeypatch.setenv(f"TIDEGATE_{name}", str(value))
        return load_settings()

    return load


def _line_of(settings):
    return make_beam_line(settings, MonotonicClock())


def test_without_settings_the_line_is_simulated_and_says_so(site):
    settings = site()
    assert (settings.mode, settings.is_simulated_beam) == ("research", True)
    assert isinstance(_line_of(settings), SimulatedBeamLine)
    assert LocalEngine(settings).is_simulated_beam


@pytest.mark.parametrize("names", [TCP, RTU, RELAY], ids=lambda names: names["BEAM_LINE"])
def test_a_real_line_is_built_from_its_settings_and_is_no_simulation(site, names):
    settings = site(**names)
    line = _line_of(settings)
    assert isinstance(line, WiredBeamLine)
    assert line._wire.name.endswith(names.get("BEAM_RTU_DEVICE") or names.get("BEAM_RELAY_DEVICE") or "127.0.0.1:502")
    assert not LocalEngine(settings).is_simulated_beam


def test_every_number_of_a_line_reaches_it(site):
    settings = site(
        **TCP,
        BEAM_MODBUS_PORT=1502,
        BEAM_MODBUS_UNIT=9,
        BEAM_MODBUS_PERMIT_COIL=10,
        BEAM_MODBUS_HEARTBEAT_REGISTER=11,
        BEAM_MODBUS_READBACK_INPUT=12,
        BEAM_ANSWER_MS=40,
        BEAM_SETTLE_MS=80,
    )
    line = _line_of(settings)
    registers = line._wire._registers
    assert (registers.unit, registers.permit_coil, registers.heartbeat_register) == (9, 10, 11)
    assert registers.readback_input == 12
    assert line._wire._client.comm_params.port == 1502
    assert (line._times.answer_ms, line._times.settle_ms) == (40.0, 80.0)


def test_every_setting_of_a_serial_line_reaches_it(site):
    rtu = _line_of(site(**RTU, BEAM_RTU_BAUD=38_400, BEAM_RTU_PARITY="odd", BEAM_RTU_STOP_BITS=2))._wire._client
    assert (rtu.comm_params.baudrate, rtu.comm_params.parity, rtu.comm_params.stopbits) == (38_400, "O", 2)


def test_every_setting_of_a_board_reaches_it(site):
    settings = site(
        **RELAY,
        BEAM_RELAY_BAUD=19_200,
        BEAM_RELAY_PROTOCOL="numato",
        BEAM_RELAY_CHANNEL=3,
        BEAM_RELAY_CONTACT="cts",
        BEAM_RELAY_HEARTBEAT_CHANNEL=4,
    )
    wire = _line_of(settings)._wire
    assert (wire._baud, wire._channel, wire._heartbeat_channel, wire._contact) == (19_200, 3, 4, "cts")


def test_two_lines_are_a_pair_and_no_simulation_only_if_neither_is_one(site):
    settings = site(**TCP, BEAM_LINE_2="serial-relay", BEAM_RELAY_DEVICE="/dev/ttyUSB1")
    assert isinstance(_line_of(settings), PairedBeamLine)
    assert not settings.is_simulated_beam


def test_every_recipient_gets_the_whole_line(site):
    settings = site(
        **TCP,
        BEAM_LINE_2="serial-relay",
        BEAM_RELAY_DEVICE="/dev/ttyUSB1",
        BEAM_NOTIFY_UDP="127.0.0.1:5000, [::1]:5001",
        BEAM_NOTIFY_HTTP="https://example.invalid/beam",
        BEAM_NOTIFY_TIMEOUT_S=2,
    )
    line = _line_of(settings)
    assert isinstance(line, PublishedBeamLine)
    assert isinstance(line._line, PairedBeamLine)
    assert len(line._publishers) == 3
    assert line._publishers[2]._sender._timeout_s == 2.0


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"MODE": "clinical"}, "MODE is clinical: TIDEGATE_BEAM_LINE is simulated"),
        ({"MODE": "clinical", **TCP, "BEAM_LINE_2": "simulated"}, "TIDEGATE_BEAM_LINE_2 is simulated beside"),
        ({"MODE": "clinical", **RELAY}, "TIDEGATE_BEAM_RELAY_HEARTBEAT_CHANNEL"),
        ({"HARDWARE_DEAD_MAN": "true"}, "TIDEGATE_HARDWARE_DEAD_MAN is true, but the beam line is simulated"),
        ({"MODE": "home"}, "TIDEGATE_MODE"),
        ({"BEAM_LINE": "modbus"}, "TIDEGATE_BEAM_LINE"),
        ({"BEAM_LINE": "modbus-tcp"}, "TIDEGATE_BEAM_MODBUS_HOST is needed"),
        ({"BEAM_LINE": "modbus-rtu"}, "TIDEGATE_BEAM_RTU_DEVICE is needed"),
        ({"BEAM_LINE": "serial-relay"}, "TIDEGATE_BEAM_RELAY_DEVICE is needed"),
        ({**TCP, "BEAM_LINE_2": "modbus-tcp"}, "another kind"),
        ({**TCP, "BEAM_LINE_2": "simulated"}, "TIDEGATE_BEAM_LINE_2 is simulated beside modbus-tcp"),
        ({**RELAY, "BEAM_LINE": "simulated", "BEAM_LINE_2": "serial-relay"}, "is serial-relay beside simulated"),
        ({"BEAM_LINE_2": "simulated"}, "TIDEGATE_BEAM_LINE_2"),
        ({"BEAM_MODBUS_HOST": "plc"}, "TIDEGATE_BEAM_MODBUS_HOST is set, but no beam line is modbus-tcp"),
        ({**TCP, "BEAM_RTU_BAUD": 9600}, "TIDEGATE_BEAM_RTU_BAUD is set, but no beam line is modbus-rtu"),
        ({**TCP, "BEAM_RELAY_CHANNEL": 2}, "TIDEGATE_BEAM_RELAY_CHANNEL is set"),
        ({"BEAM_ANSWER_MS": 50}, "TIDEGATE_BEAM_ANSWER_MS is set"),
        ({"BEAM_NOTIFY_TIMEOUT_S": 2}, "TIDEGATE_BEAM_NOTIFY_HTTP is not"),
        ({**TCP, "BEAM_ANSWER_MS": 120}, "TIDEGATE_BEAM_SETTLE_MS must be at most 40"),
        ({**RTU, "BEAM_RTU_BAUD": 10_000}, "TIDEGATE_BEAM_RTU_BAUD"),
        ({**RTU, "BEAM_RTU_DEVICE": "ttyUSB0"}, "TIDEGATE_BEAM_RTU_DEVICE must be the path"),
        ({**RTU, "BEAM_RTU_DEVICE": "socket://plc:1"}, "TIDEGATE_BEAM_RTU_DEVICE must be the path"),
        ({**RTU, "BEAM_RTU_PARITY": "mark"}, "TIDEGATE_BEAM_RTU_PARITY"),
        ({**TCP, "BEAM_MODBUS_UNIT": 0}, "TIDEGATE_BEAM_MODBUS_UNIT"),
        ({**RELAY, "BEAM_RELAY_CHANNEL": 0}, "TIDEGATE_BEAM_RELAY_CHANNEL must be"),
        ({**RELAY, "BEAM_RELAY_HEARTBEAT_CHANNEL": 1}, "TIDEGATE_BEAM_RELAY_HEARTBEAT_CHANNEL must be another"),
        ({**RELAY, "BEAM_RELAY_CONTACT": "ri"}, "TIDEGATE_BEAM_RELAY_CONTACT"),
        ({"BEAM_NOTIFY_UDP": "localhost"}, "TIDEGATE_BEAM_NOTIFY_UDP"),
        ({"BEAM_NOTIFY_UDP": "localhost:0"}, "TIDEGATE_BEAM_NOTIFY_UDP"),
        ({"BEAM_NOTIFY_UDP": "localhost:65536"}, "TIDEGATE_BEAM_NOTIFY_UDP"),
        ({"BEAM_NOTIFY_UDP": ",".join(["a:1"] * 9)}, "TIDEGATE_BEAM_NOTIFY_UDP"),
        ({"BEAM_NOTIFY_HTTP": "ftp://host/"}, "TIDEGATE_BEAM_NOTIFY_HTTP"),
        ({"BEAM_NOTIFY_HTTP": "http://me:secret@host/"}, "TIDEGATE_BEAM_NOTIFY_HTTP"),
        ({"BEAM_NOTIFY_HTTP": "http://host/" + "x" * 500}, "TIDEGATE_BEAM_NOTIFY_HTTP"),
        ({"BEAM_NOTIFY_HTTP": "http://host:99999/"}, "TIDEGATE_BEAM_NOTIFY_HTTP"),
    ],
    ids=lambda case: "+".join(case) if isinstance(case, dict) else "",
)
def test_settings_that_make_no_line_are_refused_by_name(site, names, said):
    with pytest.raises(SettingsError) as refusal:
        site(**names)
    assert said in str(refusal.value)
    assert "secret" not in str(refusal.value)


@pytest.mark.parametrize(
    "names",
    [
        TCP,
        RTU,
        {**RELAY, "BEAM_RELAY_HEARTBEAT_CHANNEL": 2},
        {**RELAY, "BEAM_LINE_2": "modbus-tcp", "BEAM_MODBUS_HOST": "plc"},
    ],
    ids="+".join,
)
def test_clinical_mode_takes_a_line_that_drops_by_itself(site, names):
    assert not site(**CLINICAL, **names).is_simulated_beam


@pytest.mark.parametrize("name", ["BEAM_WITHOUT_CALIBRATION", "ALLOW_DEVICE_REGISTRATION", "RECORDINGS_MAY_GATE"])
def test_clinical_mode_takes_nothing_that_is_for_research_alone(site, name):
    with pytest.raises(SettingsError) as refusal:
        site(**CLINICAL | TCP | {name: "true"})
    (line,) = str(refusal.value).splitlines()
    assert f"TIDEGATE_{name} is true" in line


def test_research_mode_takes_a_simulated_line(site):
    assert site(MODE="research", BEAM_LINE="simulated").is_simulated_beam


def test_every_setting_of_a_wire_belongs_to_a_line():
    wires = {name for name in BeamSettings.model_fields if name.startswith("beam_")}
    others = {"beam_line", "beam_line_2", "beam_notify_udp", "beam_notify_http", "beam_notify_timeout_s"}
    assert wires - others == {name for names in USED_BY.values() for name in names}
    assert set(BeamSettings.model_fields) <= set(Settings.model_fields)


def test_the_service_does_not_start_on_a_simulated_line_in_clinical_mode():
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "serve"],
        env={**os.environ, "TIDEGATE_MODE": "clinical"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[0].startswith("Tidegate ")
    assert "TIDEGATE_MODE is clinical: TIDEGATE_BEAM_LINE is simulated" in done.stderr
    missing = [
        name for name in OBLIGATORY if f"TIDEGATE_MODE is clinical: TIDEGATE_{name.upper()} is" not in done.stderr
    ]
    assert missing == [], "one start names all that is missing"


def test_the_line_of_the_settings_reaches_a_real_receiver(site):
    with receiver("tcp") as far:
        settings = site(
            **TCP,
            BEAM_MODBUS_PORT=far.where,
            BEAM_MODBUS_UNIT=7,
            BEAM_MODBUS_PERMIT_COIL=3,
            BEAM_MODBUS_HEARTBEAT_REGISTER=11,
            BEAM_MODBUS_READBACK_INPUT=5,
        )
        line = _line_of(settings)
        line.open()
        assert not line.is_on()
        line.close()
