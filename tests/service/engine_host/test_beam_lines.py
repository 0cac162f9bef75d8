"""Which line a site uses: named by its settings, bounded, and never a simulation where it must not be one."""

import os
import subprocess
import sys

import pytest

from engine.beam.compared_line import ComparedBeamLine
from engine.beam.heartbeat_drill import OwnInput
from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine, SimulatedReceiver
from engine.beam.status.published_line import PublishedBeamLine
from engine.beam.wire.modbus import ModbusInput
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import MonotonicClock
from service.core.settings.beam import USED_BY, BeamSettings
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.beam_lines import beam_line_parts, drilled_receivers, make_beam_line
from service.engine_host.local_engine import LocalEngine
from tests.support.beam.receivers import receiver
from tests.support.service.clinical_site import OBLIGATORY, environment
from tests.support.site_settings import give_settings

pytestmark = pytest.mark.usefixtures("no_settings_around")

TCP = {"BEAM_LINE": "modbus-tcp", "BEAM_MODBUS_HOST": "127.0.0.1"}
RTU = {"BEAM_LINE": "modbus-rtu", "BEAM_RTU_DEVICE": "/dev/ttyUSB0"}
RELAY = {"BEAM_LINE": "serial-relay", "BEAM_RELAY_DEVICE": "/dev/ttyUSB1"}
CLINICAL = environment({"mode": "clinical", **OBLIGATORY, "hardware_dead_man": True})


@pytest.fixture
def site(monkeypatch, tmp_path):
    def load(**names):
        give_settings(monkeypatch, tmp_path, **names)
        return load_settings()

    return load


def _line_of(settings):
    return make_beam_line(settings, MonotonicClock())


def test_without_settings_the_line_is_simulated_and_states_it(site):
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
    )
    line = _line_of(settings)
    assert isinstance(line, PublishedBeamLine)
    assert isinstance(line._line, PairedBeamLine)
    assert len(line._publishers) == 3
    assert line._publishers[2]._sender._timeout_s == 1.0


def test_the_accelerator_s_signal_is_no_input_until_the_site_names_one(site):
    assert not isinstance(_line_of(site(**TCP)), ComparedBeamLine)
    assert not isinstance(_line_of(Settings()), ComparedBeamLine)


def test_a_modbus_line_reads_the_signal_by_its_own_exchanges_and_compares_it(site):
    settings = site(**TCP, BEAM_ON_INPUT=6, BEAM_WITHOUT_PERMIT_MS=120)
    line = _line_of(settings)
    assert isinstance(line, ComparedBeamLine)
    assert line._line._wire._registers.beam_on_input == 6
    assert line._comparison._after_permit_ms == 120.0
    line._line._wire._beam_on = True
    assert line._read() is True
    assert settings.beam_place["beam_on_input"] == 6


@pytest.mark.parametrize("line", [TCP, {"BEAM_LINE": "modbus-rtu", "BEAM_RTU_DEVICE": "/dev/ttyUSB0"}])
def test_a_gate_is_expected_in_a_session_and_not_in_qa(site, line):
    assert _line_of(site(**line))._wire._registers.expected_coil is None
    settings = site(**line, BEAM_MODBUS_EXPECTED_COIL=9)
    assert _line_of(settings)._wire._registers.expected_coil == 9
    (part,) = beam_line_parts(settings, MonotonicClock())
    assert part.wire._registers.expected_coil is None


def test_a_relay_says_that_a_gate_is_expected_in_a_session_and_not_in_qa(site):
    assert _line_of(site(**RELAY))._wire._expected_channel is None
    settings = site(**RELAY, BEAM_RELAY_EXPECTED_CHANNEL=7)
    assert _line_of(settings)._wire._expected_channel == 7
    (part,) = beam_line_parts(settings, MonotonicClock())
    assert part.wire._expected_channel is None


def test_of_two_modbus_lines_the_first_reads_the_signal(site):
    settings = site(**TCP, BEAM_LINE_2="modbus-rtu", BEAM_RTU_DEVICE="/dev/ttyUSB0", BEAM_ON_INPUT=6)
    assert [settings.beam_registers(kind).beam_on_input for kind in settings.beam_lines] == [6, None]


def test_a_simulated_line_has_a_simulated_accelerator_if_the_site_asks_for_one(site):
    line = _line_of(site(BEAM_SIMULATED_ACCELERATOR_MS=30))
    assert isinstance(line, ComparedBeamLine)
    assert line._read() is False


def _receivers_of(settings):
    clock = MonotonicClock()
    return drilled_receivers(settings, clock, beam_line_parts(settings, clock))


def test_a_wired_line_has_no_second_input_until_the_site_names_one(site):
    (receiver,) = _receivers_of(site(**TCP))
    assert (receiver.name, receiver.second_input) == ("modbus-tcp", None)
    assert receiver.line._look is None


def test_a_simulated_line_has_a_receiver_of_its_own(site):
    (receiver,) = _receivers_of(site())
    assert isinstance(receiver.second_input, SimulatedReceiver)


def test_a_line_s_own_read_back_is_looked_at_by_another_connection_where_there_may_be_one(site):
    (tcp,) = _receivers_of(site(**TCP, BEAM_SECOND_INPUT="readback", BEAM_MODBUS_UNIT=9, BEAM_MODBUS_READBACK_INPUT=12))
    assert isinstance(tcp.second_input, ModbusInput)
    wire = tcp.second_input._wire
    assert wire is not tcp.line._wire
    assert wire._client is not tcp.line._wire._client
    assert (wire._registers.unit, wire._registers.readback_input, wire._client.comm_params.port) == (9, 12, 502)
    assert tcp.line._look is None


@pytest.mark.parametrize("names", [RTU, {**RELAY, "BEAM_RELAY_CONTACT": "cts"}], ids=["rtu", "relay"])
def test_of_a_serial_port_the_line_itself_looks_because_only_one_may_open_it(site, names):
    (serial,) = _receivers_of(site(**names, BEAM_SECOND_INPUT="readback"))
    assert isinstance(serial.second_input, OwnInput)
    assert serial.line._look == serial.line._wire.look


def test_each_of_two_lines_has_the_second_input_that_is_named_for_it(site):
    settings = site(
        **TCP,
        BEAM_LINE_2="serial-relay",
        BEAM_RELAY_DEVICE="/dev/ttyUSB1",
        BEAM_SECOND_INPUT="readback",
        BEAM_SECOND_INPUT_2="[::1]:1502/17/33",
    )
    first, second = _receivers_of(settings)
    assert (first.name, second.name) == ("modbus-tcp", "serial-relay")
    wire = second.second_input._wire
    assert (wire._client.comm_params.host, wire._client.comm_params.port) == ("::1", 1502)
    assert (wire._registers.unit, wire._registers.readback_input) == (17, 33)
    assert second.line._look is None
    assert settings.beam_place["beam_second_input_2"] == "[::1]:1502/17/33"


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"MODE": "clinical"}, "MODE is clinical: TIDEGATE_BEAM_LINE is simulated"),
        ({"MODE": "clinical", **TCP, "BEAM_LINE_2": "simulated"}, "TIDEGATE_BEAM_LINE_2 is simulated beside"),
        ({"MODE": "clinical", **RELAY}, "beam.relay_heartbeat_channel"),
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
        ({**TCP, "BEAM_RELAY_CHANNEL": 2}, "beam.relay_channel is set"),
        ({"BEAM_ANSWER_MS": 50}, "beam.answer_ms is set"),
        ({**TCP, "BEAM_ANSWER_MS": 120}, "beam.settle_ms must be at most 40"),
        ({**RTU, "BEAM_RTU_BAUD": 10_000}, "TIDEGATE_BEAM_RTU_BAUD"),
        ({**RTU, "BEAM_RTU_DEVICE": "ttyUSB0"}, "TIDEGATE_BEAM_RTU_DEVICE must be the path"),
        ({**RTU, "BEAM_RTU_DEVICE": "socket://plc:1"}, "TIDEGATE_BEAM_RTU_DEVICE must be the path"),
        ({**RTU, "BEAM_RTU_PARITY": "mark"}, "beam.rtu_parity"),
        ({**TCP, "BEAM_MODBUS_UNIT": 0}, "beam.modbus_unit"),
        ({**RELAY, "BEAM_RELAY_CHANNEL": 0}, "beam.relay_channel must be"),
        ({**RELAY, "BEAM_RELAY_HEARTBEAT_CHANNEL": 1}, "beam.relay_heartbeat_channel must be another"),
        ({**RELAY, "BEAM_RELAY_CONTACT": "ri"}, "beam.relay_contact"),
        ({"BEAM_ON_INPUT": 6}, "TIDEGATE_BEAM_ON_INPUT is set, but no beam line is modbus-tcp or modbus-rtu"),
        ({**TCP, "BEAM_ON_INPUT": 65_536}, "TIDEGATE_BEAM_ON_INPUT"),
        ({**TCP, "BEAM_ON_INPUT": 0}, "TIDEGATE_BEAM_ON_INPUT must be another input than the read back's"),
        ({**TCP, "BEAM_ON_INPUT": 6, "BEAM_WITHOUT_PERMIT_MS": 19}, "beam.without_permit_ms"),
        ({**TCP, "BEAM_ON_INPUT": 6, "BEAM_WITHOUT_PERMIT_MS": 1001}, "beam.without_permit_ms"),
        ({**TCP, "BEAM_WITHOUT_PERMIT_MS": 100}, "without_permit_ms is set, but neither TIDEGATE_BEAM_ON_INPUT nor"),
        ({"BEAM_SIMULATED_ACCELERATOR_MS": 2001}, "beam.simulated_accelerator_ms"),
        (
            {**TCP, "BEAM_SIMULATED_ACCELERATOR_MS": 30},
            "simulated_accelerator_ms is set, but no beam line is simulated",
        ),
        ({"BEAM_SECOND_INPUT": "readback"}, "TIDEGATE_BEAM_SECOND_INPUT is set, but there is no such wired line"),
        ({**TCP, "BEAM_SECOND_INPUT_2": "readback"}, "TIDEGATE_BEAM_SECOND_INPUT_2 is set, but there is no such"),
        ({**RELAY, "BEAM_SECOND_INPUT": "readback"}, "BEAM_SECOND_INPUT is readback: set beam.relay_contact"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc"}, "TIDEGATE_BEAM_SECOND_INPUT: must be readback, or HOST:PORT/UNIT/INPUT"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:502/1"}, "must be readback, or HOST:PORT/UNIT/INPUT"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:0/1/0"}, "TIDEGATE_BEAM_SECOND_INPUT"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:65536/1/0"}, "TIDEGATE_BEAM_SECOND_INPUT"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:502/0/0"}, "UNIT is 0: must be"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:502/1/65536"}, "INPUT is 65536: must be"),
        ({**TCP, "BEAM_SECOND_INPUT": "plc:502/1/-1"}, "must be readback, or HOST:PORT/UNIT/INPUT"),
        ({**TCP, "BEAM_SECOND_INPUT": "me:secret@plc:502/1/0"}, "TIDEGATE_BEAM_SECOND_INPUT"),
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
    assert f"{setting_name(name.lower())} is true" in line


def test_research_mode_takes_a_simulated_line(site):
    assert site(MODE="research", BEAM_LINE="simulated").is_simulated_beam


def test_every_setting_of_a_wire_belongs_to_a_line():
    wires = {name for name in BeamSettings.model_fields if name.startswith("beam_")}
    others = {"beam_line", "beam_line_2", "beam_notify_udp", "beam_notify_http"}
    others |= {"beam_second_input", "beam_second_input_2"}
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
    missing = [name for name in OBLIGATORY if f"TIDEGATE_MODE is clinical: {setting_name(name)} is" not in done.stderr]
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
