"""What goes over the wires, byte by byte, and what of an answer counts."""

import os
import select
import threading
import time
import tty

import pytest
from pymodbus.client import ModbusTcpClient

from engine.beam.wire import serial_relay
from engine.beam.wire.modbus import rtu_wire, tcp_wire
from engine.beam.wire.register_map import MAP_BOUNDS, RegisterMap
from engine.beam.wire.serial_relay import RELAY_PROTOCOLS, RelayWire
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import MonotonicClock
from engine.core.errors import BeamLineError, InvalidValueError
from tests.support.beam.receivers import PATIENCE_S, REGISTERS, receiver

QUESTIONS = {RELAY_PROTOCOLS[kind].request(channel) for kind in RELAY_PROTOCOLS for channel in (1, 11)}


class FakePort:
    """A board that says what it is set to say, a piece at a time, and a modem line that is what it is set to."""

    def __init__(self, answers, **lines):
        self.answers, self.written, self.is_open, self.is_asked = list(answers), [], True, False
        self.cts = self.dsr = self.cd = False
        for name, state in lines.items():
            setattr(self, name, state)

    def write(self, sent):
        self.written.append(sent)
        self.is_asked |= sent in QUESTIONS

    def reset_input_buffer(self):
        self.written.append(None)

    @property
    def in_waiting(self):
        return len(self.answers[0]) if self.answers and self.is_asked else 0

    def read(self, _size):
        return self.answers.pop(0) if self.answers else b""

    def close(self):
        self.is_open = False


def relay(port, protocol="lcus", **options):
    wire = RelayWire(device="/dev/none", baud=9_600, protocol=protocol, **{"channel": 1, **options})
    wire._port = port
    return wire


def test_an_lcus_board_is_sent_its_frames_and_asked_for_its_state():
    port = FakePort([b"\xa0\x01\x01\xa2"])
    assert relay(port).exchange(is_on=True, heartbeat=1, within_s=0.1) is True
    assert port.written == [b"\xa0\x01\x01\xa2", None, b"\xa0\x01\x05\xa6"]
    port = FakePort([b"\xa0\x01\x00\xa1"])
    assert relay(port).exchange(is_on=False, heartbeat=1, within_s=0.1) is False
    assert port.written[0] == b"\xa0\x01\x00\xa1"


def test_a_numato_board_is_sent_its_words_with_its_own_numbering():
    port = FakePort([b"relay off B\n\r>relay re", b"ad B\n\roff\n\r", b">"])
    assert relay(port, "numato", channel=11).exchange(is_on=False, heartbeat=1, within_s=0.1) is False
    assert port.written == [b"relay off B\r", None, b"relay read B\r"]


@pytest.mark.parametrize(("heartbeat", "code"), [(1, b"\xa0\x02\x01\xa3"), (2, b"\xa0\x02\x00\xa2")])
def test_the_heartbeat_s_relay_switches_at_every_count(heartbeat, code):
    port = FakePort([b"\xa0\x01\x01\xa2"])
    relay(port, heartbeat_channel=2).exchange(is_on=True, heartbeat=heartbeat, within_s=0.1)
    assert port.written[1] == code


def test_a_gate_is_expected_with_every_exchange_and_not_once_the_line_is_closed():
    """A relay of its own: an accelerator can distinguish a held beam from a beam without gating."""
    port = FakePort([b"\xa0\x01\x00\xa1"])
    wire = relay(port, expected_channel=3)
    wire.exchange(is_on=False, heartbeat=1, within_s=0.1)
    assert port.written[:2] == [b"\xa0\x01\x00\xa1", b"\xa0\x03\x01\xa4"]
    wire.close()
    assert port.written[-1] == b"\xa0\x03\x00\xa3"


@pytest.mark.parametrize(
    ("protocol", "said", "state"),
    [
        ("lcus", b"\xa0\x01\x01\xa2", True),
        ("lcus", b"\xa0\x01\x00\xa1", False),
        ("lcus", b"\xa0\x01\x01", None),
        ("lcus-text", b"CH1: ON \r\nCH2: OFF \r\n", True),
        ("lcus-text", b"CH1:OFF\r\nCH2:ON\r\n", False),
        ("lcus-text", b"ch1: on", None),
        ("lcus-text", b"CH11: ON\r\n", None),
        ("lcus-text", b"CH1: ON\r", True),
        ("lcus-text", b"CH2: ON\rCH1: OFF\r", False),
        ("lcus-text", b"hello\nCH1: ON\n", True),
        ("numato", b"relay read 1\n\ron\n\r>", True),
        ("numato", b"relay on 1\n\r>relay read 1\n\roff\n\r>", False),
        ("numato", b"relay read 1\n\ron\n\r", None),
        ("numato", b"relay on 1\n\r>", None),
        ("numato", b"relay read 1\n\roff\n\r>relay read 1\n\ron\n\r>", True),
        ("numato", b"relay read 1\n\ron\n\r> ", True),
        ("numato", b"relay read 1 on>", True),
    ],
)
def test_a_status_is_read_only_when_it_is_whole(protocol, said, state):
    assert RELAY_PROTOCOLS[protocol].parse(said, 1) is state


@pytest.mark.parametrize(
    ("protocol", "said"),
    [
        ("lcus", b"\xa0\x02\x01\xa3"),
        ("lcus", b"\xa0\x01\x01\xa3"),
        ("lcus", b"\xa0\x01\x01\xa2\xa0"),
        ("lcus-text", b"CH1: ONLINE\r\n"),
        ("lcus-text", b"CH1: ON: OFF\r\n"),
        ("numato", b"relay read 1\n\rinvalid\n\r>"),
        ("numato", b"relay read 1\n\ron\n\roff\n\r>"),
    ],
)
def test_a_status_that_is_none_is_an_error_not_a_state(protocol, said):
    with pytest.raises(BeamLineError, match=r"no sta"):
        RELAY_PROTOCOLS[protocol].parse(said, 1)


def test_a_board_that_states_nothing_or_chatters_without_end_is_given_up():
    with pytest.raises(BeamLineError, match="no status within the time"):
        relay(FakePort([])).exchange(is_on=True, heartbeat=1, within_s=0.02)
    port = FakePort([b"x" * 60] * 1000)
    with pytest.raises(BeamLineError, match="received b'x"):
        relay(port, "numato").exchange(is_on=True, heartbeat=1, within_s=5.0)
    assert len(port.answers) > 900


@pytest.mark.parametrize("line", ["cts", "dsr", "cd"])
@pytest.mark.parametrize("is_on", [True, False])
@pytest.mark.parametrize("board", [True, False])
@pytest.mark.parametrize("contact", [True, False])
def test_board_and_contact_must_both_confirm_the_command(line, is_on, board, contact):
    port = FakePort([b"\xa0\x01\x01\xa2" if board else b"\xa0\x01\x00\xa1"], **{line: contact})
    read = relay(port, contact=line).exchange(is_on=is_on, heartbeat=1, within_s=0.1)
    assert read is (is_on if board is is_on and contact is is_on else not is_on)


@pytest.mark.parametrize("line", ["cts", "dsr", "cd"])
@pytest.mark.parametrize("contact", [True, False])
def test_a_look_at_the_contact_reads_the_modem_line_and_sends_nothing(line, contact):
    port = FakePort([], **{line: contact})
    wire = relay(port, contact=line)
    sent = list(port.written)
    assert wire.look(0.1) is contact
    assert port.written == sent


def test_a_look_without_a_modem_line_or_a_port_is_an_error():
    with pytest.raises(BeamLineError, match="no modem line"):
        relay(FakePort([])).look(0.1)
    closed = relay(FakePort([]), contact="cts")
    closed.close()
    with pytest.raises(BeamLineError, match="closed"):
        closed.look(0.1)


def test_a_port_that_is_closed_takes_nothing():
    wire = relay(FakePort([]))
    wire.close()
    wire.close()
    with pytest.raises(BeamLineError, match="closed"):
        wire.exchange(is_on=True, heartbeat=1, within_s=0.1)


def test_what_the_board_had_still_to_say_is_thrown_away_when_connecting(monkeypatch):
    port = FakePort([b"\xa0\x01\x01\xa2", b"\xa0", b"", STATUS_OFF])
    wire = connecting(port, monkeypatch)
    wire.connect()
    assert port.answers == []
    assert port.written == [b"\xa0\x01\x05\xa6"], "asked, and nothing ordered"


def connecting(port, monkeypatch, protocol="lcus"):
    monkeypatch.setattr(serial_relay.serial, "Serial", lambda *_args, **_options: port)
    return relay(None, protocol)


STATUS_ON, STATUS_OFF = b"\xa0\x01\x01\xa2", b"\xa0\x01\x00\xa1"
ECHOED_QUESTION = b"\xa0\x01\x05\xa6"


@pytest.mark.parametrize("protocol", RELAY_PROTOCOLS)
@pytest.mark.parametrize("pieces", [1, 2, 100], ids=["whole", "halves", "bytes"])
def test_a_port_that_echoes_the_question_is_no_board_and_is_commanded_off_and_closed(monkeypatch, protocol, pieces):
    question = RELAY_PROTOCOLS[protocol].request(1)
    size = max(len(question) // pieces, 1)
    port = FakePort([b"", *(question[at : at + size] for at in range(0, len(question), size))])
    wire = connecting(port, monkeypatch, protocol)
    with pytest.raises(BeamLineError, match="returns what is sent to it"):
        wire.connect()
    assert port.written == [question, RELAY_PROTOCOLS[protocol].command(1, False)]
    assert not port.is_open
    with pytest.raises(BeamLineError, match="closed"):
        wire.exchange(is_on=True, heartbeat=1, within_s=0.1)


def test_a_board_that_echoes_beside_its_answers_is_refused(monkeypatch):
    wire = connecting(FakePort([b"", ECHOED_QUESTION + STATUS_OFF]), monkeypatch)
    with pytest.raises(BeamLineError, match="returns what is sent to it"):
        wire.connect()


@pytest.mark.parametrize("is_on", [True, False])
@pytest.mark.parametrize(
    "said",
    [[STATUS_ON + ECHOED_QUESTION], [STATUS_ON, ECHOED_QUESTION], [STATUS_OFF, STATUS_OFF], [STATUS_ON, b"\xa0"]],
)
def test_an_order_s_echo_is_no_status_for_more_comes_behind_it(is_on, said):
    with pytest.raises(BeamLineError, match=r"no status|more than its status"):
        relay(FakePort(said)).exchange(is_on=is_on, heartbeat=1, within_s=0.1)


def test_what_comes_behind_a_status_later_refuses_the_next_permit_before_it_is_ordered():
    port = FakePort([STATUS_OFF])
    wire = relay(port)
    wire.exchange(is_on=False, heartbeat=1, within_s=0.1)
    port.answers, port.written = [ECHOED_QUESTION], []
    with pytest.raises(BeamLineError, match="more than its status"):
        wire.exchange(is_on=True, heartbeat=2, within_s=0.1)
    assert port.written == []


def test_an_off_is_ordered_whatever_else_the_board_has_to_say():
    port = FakePort([STATUS_OFF])
    wire = relay(port)
    wire.exchange(is_on=False, heartbeat=1, within_s=0.1)
    port.answers, port.written = [ECHOED_QUESTION], []
    with pytest.raises(BeamLineError, match="more than its status"):
        wire.exchange(is_on=False, heartbeat=2, within_s=0.1)
    assert port.written == [STATUS_OFF]


def test_a_numato_board_s_own_echo_is_part_of_its_answer_and_an_echo_alone_is_none():
    asked, order = b"relay read 1\r", b"relay on 1\r"
    assert relay(FakePort([asked, b"\n\ron\n\r>"]), "numato").exchange(is_on=True, heartbeat=1, within_s=0.1)
    with pytest.raises(BeamLineError, match="within the time"):
        relay(FakePort([order, asked]), "numato").exchange(is_on=True, heartbeat=1, within_s=0.05)


@pytest.fixture
def echoing_port():
    """A serial port whose end sends back every byte, as a wire at 9600 baud does: a loop-back plug, a cooked tty."""
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    is_over = threading.Event()

    def echo():
        while not is_over.is_set():
            readable, _, _ = select.select([master], [], [], 0.01)
            for byte in os.read(master, 256) if readable else b"":
                is_over.wait(0.001)
                os.write(master, bytes((byte,)))

    thread = threading.Thread(target=echo)
    thread.start()
    yield os.ttyname(slave)
    is_over.set()
    thread.join()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("protocol", RELAY_PROTOCOLS)
def test_a_real_port_that_only_echoes_makes_no_line(echoing_port, protocol):
    wire = RelayWire(device=echoing_port, baud=9_600, protocol=protocol, channel=1, heartbeat_channel=2)
    line = WiredBeamLine(wire, MonotonicClock())
    with pytest.raises(BeamLineError, match="returns what is sent to it"):
        line.open()


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"channel": 0}, "channel"),
        ({"channel": 17}, "channel"),
        ({"protocol": "numato", "channel": 32}, "channel"),
        ({"channel": 1, "heartbeat_channel": 1}, "heartbeat_channel"),
        ({"channel": 1, "heartbeat_channel": 99}, "heartbeat_channel"),
        ({"channel": 1, "baud": 300}, "baud"),
    ],
    ids=str,
)
def test_a_relay_that_no_board_has_is_refused(options, field):
    with pytest.raises(InvalidValueError, match=f"^{field}"):
        RelayWire(**{"device": "/dev/none", "baud": 9_600, "protocol": "lcus", **options})


@pytest.mark.parametrize("name", MAP_BOUNDS)
@pytest.mark.parametrize("value", [-1, 65_536, 1.5, True])
def test_an_address_that_no_device_has_is_refused(name, value):
    with pytest.raises(InvalidValueError, match=name):
        RegisterMap(**{name: value})


def test_unit_0_would_be_a_broadcast_without_an_answer():
    with pytest.raises(InvalidValueError, match="unit"):
        RegisterMap(unit=0)


def test_a_speed_that_no_line_has_is_refused():
    with pytest.raises(InvalidValueError, match="baud"):
        rtu_wire(device="/dev/none", baud=1_200, parity="even", stop_bits=1, registers=REGISTERS)


def connected(wire):
    """Connect; tried again where a busy machine took its time."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            wire.connect()
        except BeamLineError:
            assert time.monotonic() < deadline_s, "it never connected"
        else:
            return


@pytest.mark.parametrize(
    ("registers", "refused"),
    [
        (RegisterMap(unit=7, permit_coil=400, heartbeat_register=11, readback_input=5), "the permit"),
        (RegisterMap(unit=7, permit_coil=3, heartbeat_register=12, readback_input=5), "the heartbeat"),
        (RegisterMap(unit=7, permit_coil=3, heartbeat_register=11, readback_input=600), "the read back"),
    ],
    ids=["coil", "register", "input"],
)
def test_a_device_without_the_address_is_reported_by_its_refusal(registers, refused):
    with receiver("tcp") as far:
        wire = tcp_wire(host="127.0.0.1", port=int(far.where), registers=registers)
        connected(wire)
        with pytest.raises(BeamLineError, match=f"refuses {refused} .Modbus exception"):
            wire.exchange(is_on=False, heartbeat=1, within_s=PATIENCE_S)
        wire.close()


def test_a_device_that_confirms_another_permit_than_commanded_is_refused(monkeypatch):
    write_coil = ModbusTcpClient.write_coil
    with receiver("tcp") as far:
        wire = tcp_wire(host="127.0.0.1", port=int(far.where), registers=REGISTERS)
        connected(wire)
        monkeypatch.setattr(
            ModbusTcpClient,
            "write_coil",
            lambda client, address, value, **options: write_coil(client, address, not value, **options),
        )
        with pytest.raises(BeamLineError, match="something different than was written: the permit"):
            wire.exchange(is_on=False, heartbeat=1, within_s=PATIENCE_S)
        wire.close()


def test_a_wire_that_lost_its_connection_does_not_make_one_by_itself():
    with receiver("tcp") as far:
        wire = tcp_wire(host="127.0.0.1", port=int(far.where), registers=REGISTERS)
        with pytest.raises(BeamLineError, match="connection is gone"):
            wire.exchange(is_on=True, heartbeat=1, within_s=1.0)
        assert far.seen == []


def test_what_was_decided_before_this_process_was_stopped_is_not_reported_when_it_goes_on():
    with receiver("tcp") as far:
        wire = tcp_wire(host="127.0.0.1", port=int(far.where), registers=REGISTERS)
        connected(wire)
        with pytest.raises(BeamLineError, match="time for an answer is over"):
            wire.exchange(is_on=True, heartbeat=1, within_s=0.0)
        wire.close()
    assert far.seen == []
    port = FakePort([b"\xa0\x01\x01\xa2"])
    with pytest.raises(BeamLineError, match="time for an answer is over"):
        relay(port).exchange(is_on=True, heartbeat=1, within_s=0.0)
    assert port.written == []


def test_the_library_does_not_log_what_is_reported_as_a_trouble(caplog):
    wire = tcp_wire(host="127.0.0.1", port=1, registers=REGISTERS)
    with pytest.raises(BeamLineError, match="cannot connect"):
        wire.connect()
    assert caplog.records == []


@pytest.mark.parametrize(("channel", "letter"), [(0, b"0"), (9, b"9"), (10, b"A"), (11, b"B"), (31, b"V")])
def test_a_numato_board_counts_to_9_and_then_in_letters(channel, letter):
    board = RELAY_PROTOCOLS["numato"]
    assert board.request(channel) == b"relay read " + letter + b"\r"
    assert board.command(channel, True) == b"relay on " + letter + b"\r"


@pytest.mark.parametrize(
    ("protocol", "low", "high"), [("lcus", 1, 16), ("lcus-text", 1, 16), ("numato", 0, 31)], ids=str
)
@pytest.mark.parametrize("field", ["channel", "heartbeat_channel", "expected_channel"])
def test_the_first_and_the_last_relay_are_relays_and_what_is_refused_is_named_with_its_bound(
    protocol, low, high, field
):
    other = {"channel": 5, "heartbeat_channel": 6, "expected_channel": 7}
    for number in (low, high):
        serial_relay.check_channels(protocol, **(other | {field: number}))
    for number in (low - 1, high + 1):
        with pytest.raises(InvalidValueError) as refused:
            serial_relay.check_channels(protocol, **(other | {field: number}))
        assert (refused.value.field, refused.value.value) == (field, repr(number))
        assert refused.value.bound == f"a whole number from {low} to {high} for {protocol}"
    with pytest.raises(InvalidValueError) as refused:
        serial_relay.check_channels(protocol, 5, 5)
    with pytest.raises(InvalidValueError, match=r"^expected_channel .*another than heartbeat_channel 6"):
        serial_relay.check_channels(protocol, 5, 6, 6)
    assert (refused.value.field, refused.value.value) == ("heartbeat_channel", "5")
    assert refused.value.bound == "another than channel 5"


def test_a_port_is_opened_for_this_program_alone_with_its_speed_and_patience(monkeypatch):
    opened = []
    port = FakePort([b"", STATUS_OFF])
    monkeypatch.setattr(
        serial_relay.serial, "Serial", lambda *where, **options: (opened.append((where, options)), port)[1]
    )
    wire = relay(None)
    wire.connect()
    assert wire._port is port
    options = {"baudrate": 9_600, "timeout": 0.05, "write_timeout": 0.5, "exclusive": True}
    assert opened == [(("/dev/none",), options)]


@pytest.mark.parametrize(
    ("heartbeat", "state"), [(0, b"\xa0\x02\x00\xa2"), (3, b"\xa0\x02\x01\xa3"), (4, b"\xa0\x02\x00\xa2")]
)
def test_the_heartbeat_s_relay_is_on_at_every_odd_count_and_an_order_may_take_what_the_exchange_may(heartbeat, state):
    port = FakePort([STATUS_ON])
    relay(port, heartbeat_channel=2).exchange(is_on=True, heartbeat=heartbeat, within_s=0.125)
    assert port.written[1] == state
    assert port.write_timeout == 0.125


def test_no_order_is_sent_at_the_very_end_of_the_time_for_it(monkeypatch):
    monkeypatch.setattr(serial_relay.time, "monotonic", lambda: 7.0)
    port = FakePort([STATUS_ON])
    with pytest.raises(BeamLineError, match="time for an answer is over"):
        relay(port).exchange(is_on=True, heartbeat=1, within_s=0.0)
    assert port.written == []


class PacedPort(FakePort):
    """A board on a clock that only its reading moves, `step_s` at a time."""

    def __init__(self, answers, monkeypatch, *, step_s):
        super().__init__(answers)
        self.now_s, self.step_s = 4.0, step_s
        monkeypatch.setattr(serial_relay.time, "monotonic", lambda: self.now_s)

    def read(self, size):
        self.now_s += self.step_s
        return super().read(size)


def test_what_a_port_has_still_to_say_is_listened_to_for_half_a_second_and_not_once_more(monkeypatch):
    port = PacedPort([b"\xa0", b"\xa0", STATUS_OFF], monkeypatch, step_s=0.25)
    connecting(port, monkeypatch).connect()
    assert port.answers == []
    assert port.written == [ECHOED_QUESTION]


def test_an_answer_that_begins_at_the_very_end_of_its_time_is_not_read_any_more(monkeypatch):
    port = PacedPort([STATUS_ON[:2], STATUS_ON[2:]], monkeypatch, step_s=0.25)
    with pytest.raises(BeamLineError, match="no status within the time; received"):
        relay(port).exchange(is_on=True, heartbeat=1, within_s=0.25)
    assert port.answers == [STATUS_ON[2:]]


@pytest.mark.parametrize(("chatter_bytes", "is_accepted"), [(511, True), (512, False), (513, False)])
def test_a_board_may_say_511_bytes_before_its_answer_and_not_one_more(chatter_bytes, is_accepted):
    port = FakePort([b"x" * chatter_bytes, b"relay read 1\n\ron\n\r>"])
    wire = relay(port, "numato")
    if is_accepted:
        assert wire.exchange(is_on=True, heartbeat=1, within_s=PATIENCE_S)
        return
    with pytest.raises(BeamLineError, match="received b'x"):
        wire.exchange(is_on=True, heartbeat=1, within_s=PATIENCE_S)
    assert len(port.answers) == 1


class NotedPort(PacedPort):
    """And notes for how long each reading may wait, and for how many bytes."""

    timeout = None

    def __init__(self, answers, monkeypatch, *, step_s):
        super().__init__(answers, monkeypatch, step_s=step_s)
        self.readings = []

    def read(self, size):
        self.readings.append((self.timeout, size))
        return super().read(size)


def test_no_reading_waits_for_longer_than_what_is_left_nor_for_more_bytes_than_there_are(monkeypatch):
    port = NotedPort([STATUS_ON[:1], STATUS_ON[1:]], monkeypatch, step_s=0.25)
    assert relay(port).exchange(is_on=True, heartbeat=1, within_s=1.0)
    assert port.readings == [(1.0, 1), (0.75, 3)]
    silent = NotedPort([], monkeypatch, step_s=0.4990234375)
    with pytest.raises(BeamLineError, match="no status within the time"):
        relay(silent).exchange(is_on=True, heartbeat=1, within_s=0.5)
    assert silent.readings == [(0.5, 1), (0.002, 1)]
