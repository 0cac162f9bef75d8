"""The Modbus wire on a client that notes what it was asked, in time that only the test moves."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
from pymodbus.exceptions import ModbusException

from engine.beam.wire import modbus
from engine.beam.wire.modbus import CONNECT_S, ModbusInput, ModbusWire, rtu_wire, tcp_wire
from engine.beam.wire.register_map import MAP_BOUNDS, RegisterMap
from engine.core.errors import BeamLineError, InvalidValueError

MAP = RegisterMap(unit=9, permit_coil=31, heartbeat_register=47, readback_input=58)


class Answer(SimpleNamespace):
    """A good answer, unless it is asked to be none; of the question's function unless it is another's."""

    is_refusal = False
    function_code, dev_id, registers = None, 9, None

    def isError(self):  # noqa: N802 - pymodbus's name
        return self.is_refusal

    def to(self, function, registers=None):
        self.function_code = self.function_code or function
        self.registers = registers if self.registers is None else self.registers
        return self


def byte(first):
    """The bits of an answer to a question for one input: a whole byte."""
    return [first, *[not first] * 7]


class Client:
    """Does as a device does that has all it is asked for."""

    def __init__(self, *, reads_on=True):
        self.asked, self.connected, self.connects = [], True, True
        self.comm_params = SimpleNamespace(timeout_connect=None)
        self.confirmed = Answer(address=31, bits=[True])
        self.kept = Answer(address=47)
        self.read = Answer(bits=byte(reads_on))
        self.takes_s, self.now_s, self.error = 0.0, 100.0, None

    def _ask(self, *what, **options):
        self.asked.append((*what, options, self.comm_params.timeout_connect))
        self.now_s += self.takes_s
        if self.error is not None:
            raise self.error

    def connect(self):
        self.asked.append(("connect", self.comm_params.timeout_connect))
        return self.connects

    def close(self):
        self.asked.append("close")

    def write_coil(self, address, value, **options):
        self._ask("coil", address, value, **options)
        return self.confirmed.to(5)

    def write_register(self, address, value, **options):
        self._ask("register", address, value, **options)
        return replaced(self.kept).to(6, [value])

    def read_discrete_inputs(self, address, **options):
        self._ask("input", address, **options)
        return self.read.to(2)


@pytest.fixture
def client(monkeypatch):
    held = Client()
    monkeypatch.setattr(modbus.time, "monotonic", lambda: held.now_s)
    return held


def wire(client):
    return ModbusWire(client, MAP, name="the beam line at test")


def test_an_exchange_is_three_requests_each_with_what_is_left_of_the_time(client):
    client.takes_s = 0.01
    assert wire(client).exchange(is_on=True, heartbeat=513, within_s=0.1) is True
    assert client.asked == [
        ("coil", 31, True, {"device_id": 9}, pytest.approx(0.10)),
        ("register", 47, 513, {"device_id": 9}, pytest.approx(0.09)),
        ("input", 58, {"count": 1, "device_id": 9}, pytest.approx(0.08)),
    ]


@pytest.mark.parametrize("reads_on", [True, False])
def test_what_is_returned_is_the_first_input(client, reads_on):
    client.read = Answer(bits=byte(reads_on))
    assert wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1) is reads_on


@pytest.mark.parametrize("bits", [[True] + [False] * 7, [True]])
def test_a_device_may_confirm_a_coil_in_a_whole_byte(client, bits):
    client.confirmed = Answer(address=31, bits=bits)
    assert wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


@pytest.mark.parametrize(("address", "bits"), [(32, [True]), (31, [False]), (31, [])])
def test_a_confirmation_of_another_permit_ends_the_exchange_at_once(client, address, bits):
    client.confirmed = Answer(address=address, bits=bits)
    with pytest.raises(BeamLineError, match=r"^it confirms something different than was written: the permit$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)
    assert len(client.asked) == 1


@pytest.mark.parametrize(
    ("takes_s", "requests"), [(0.0625, 2), (0.125, 1), (0.25, 1)], ids=["the third", "at its very end", "the second"]
)
def test_nothing_is_asked_when_the_time_for_the_whole_exchange_is_over(client, takes_s, requests):
    client.takes_s = takes_s
    with pytest.raises(BeamLineError, match=r"^the time for an answer is over$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.125)
    assert len(client.asked) == requests


def test_a_connection_that_went_between_two_requests_is_not_made_again(client):
    def lose(*_what, **_options):
        client.connected = False
        return client.confirmed.to(5)

    client.write_coil = lose
    with pytest.raises(BeamLineError, match=r"^the connection is gone$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)
    assert client.asked == []


@pytest.mark.parametrize(
    ("name", "asked"), [("confirmed", "the permit"), ("kept", "the heartbeat"), ("read", "the read back")]
)
@pytest.mark.parametrize(("code", "shown"), [({"exception_code": 2}, "2"), ({}, r"\?")])
def test_a_refusal_is_reported_by_what_was_refused_and_its_code(client, name, asked, code, shown):
    setattr(client, name, Answer(is_refusal=True, **code))
    with pytest.raises(BeamLineError, match=rf"^it refuses {asked} \(Modbus exception {shown}\)$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


def test_what_the_library_raises_is_reported_in_its_own_words(client):
    client.error = ModbusException("no response")
    with pytest.raises(BeamLineError, match="no response"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


@pytest.mark.parametrize("bits", [[], [True], [True] * 16])
def test_an_answer_of_another_length_than_was_asked_for_is_none(client, bits):
    client.read = Answer(bits=bits)
    with pytest.raises(BeamLineError, match=rf"^an answer of {len(bits)} bits to a question for one: the read back$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


@pytest.mark.parametrize(
    ("name", "function", "what"),
    [("confirmed", 6, "the permit"), ("kept", 5, "the heartbeat"), ("read", 1, "the read back")],
)
def test_the_answer_to_another_question_is_none(client, name, function, what):
    """A gateway that mixes answers up: coils in place of inputs, a register in place of a coil."""
    setattr(client, name, replaced(getattr(client, name), function_code=function))
    with pytest.raises(BeamLineError, match=rf"^it answers function {function} of device 9, .*: {what}$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)
    setattr(client, name, replaced(getattr(client, name), function_code=None, dev_id=8))
    with pytest.raises(BeamLineError, match=rf"of device 8, .*: {what}$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


def replaced(answer, **changes):
    return Answer(**{**vars(answer), **changes})


@pytest.mark.parametrize("changes", [{"registers": [2]}, {"registers": []}, {"address": 48}])
def test_a_confirmation_of_another_heartbeat_ends_the_exchange(client, changes):
    client.kept = Answer(**{"address": 47, **changes})
    with pytest.raises(BeamLineError, match=r"^it confirms something different than was written: the heartbeat$"):
        wire(client).exchange(is_on=True, heartbeat=1, within_s=0.1)


def test_a_look_compares_the_answer_too(client):
    client.read = Answer(bits=byte(True), function_code=1)
    with pytest.raises(BeamLineError, match=r"^it answers function 1"):
        wire(client).look(0.1)


def test_connecting_begins_with_a_closed_client_and_its_own_patience(client):
    client.comm_params.timeout_connect = 0.003
    wire(client).connect()
    assert client.asked == ["close", ("connect", CONNECT_S)]
    client.connects = False
    with pytest.raises(BeamLineError, match=r"^cannot connect$"):
        wire(client).connect()


def test_a_client_never_tries_again_and_is_patient_for_half_a_second(monkeypatch):
    made = []
    for name in ("ModbusTcpClient", "ModbusSerialClient"):
        monkeypatch.setattr(modbus, name, lambda *where, **options: made.append((where, options)))
    assert tcp_wire(host="plc", port=1502, registers=MAP).name == "the beam line at plc:1502"
    assert (
        rtu_wire(device="/dev/x", baud=9600, parity="odd", stop_bits=2, registers=MAP).name == "the beam line on /dev/x"
    )
    both = {"timeout": 0.5, "retries": 0}
    assert made == [
        (("plc",), {"port": 1502, **both}),
        (("/dev/x",), {"baudrate": 9600, "bytesize": 8, "parity": "O", "stopbits": 2, **both}),
    ]


def test_the_library_s_own_logger_is_silenced_and_no_other():
    logging.getLogger("pymodbus").setLevel(logging.NOTSET)
    root = logging.getLogger().level
    tcp_wire(host="plc", port=1502, registers=MAP)
    assert logging.getLogger("pymodbus").level == logging.CRITICAL
    assert logging.getLogger().level == root


@pytest.mark.parametrize("name", MAP_BOUNDS)
def test_the_bounds_of_every_address_belong_to_it_and_what_is_refused_is_named(name):
    low, high = MAP_BOUNDS[name]
    for value in (low, high):
        assert getattr(RegisterMap(**{name: value}), name) == value
    for value in (low - 1, high + 1):
        with pytest.raises(InvalidValueError) as refused:
            RegisterMap(**{name: value})
        assert (refused.value.field, refused.value.value) == (name, repr(value))
        assert refused.value.bound == f"a whole number from {low} to {high}"


@pytest.mark.parametrize("reads_on", [True, False])
def test_a_look_reads_the_input_and_writes_nothing(client, reads_on):
    client.read = Answer(bits=byte(reads_on))
    assert wire(client).look(0.1) is reads_on
    assert client.asked == [("input", 58, {"count": 1, "device_id": 9}, pytest.approx(0.1))]


def test_a_second_input_connects_reads_and_disconnects_and_its_errors_say_which_it_is(client):
    second_input = ModbusInput(wire(client))
    second_input.open()
    assert second_input.is_closed() is True
    second_input.close()
    assert {request[0] for request in client.asked if request != "close"} == {"connect", "input"}
    client.read = Answer(is_refusal=True, exception_code=2)
    with pytest.raises(BeamLineError, match=r"^the second input, the beam line at test: it refuses the read back"):
        second_input.is_closed()
    client.connects = False
    with pytest.raises(BeamLineError, match=r"^the second input, the beam line at test: cannot connect"):
        second_input.open()
    client.error = ModbusException("no response")
    with pytest.raises(BeamLineError, match=r"^the second input, .*no response"):
        second_input.is_closed()


def test_the_beam_on_signal_is_a_fourth_request_and_known_until_the_connection_ends(client):
    signals = {58: Answer(bits=byte(True)).to(2), 59: Answer(bits=byte(False)).to(2)}
    client.read_discrete_inputs = lambda address, **options: (
        client._ask("input", address, **options) or signals[address]
    )
    one = ModbusWire(client, replace(MAP, beam_on_input=59), name="the beam line at test")
    assert one.beam_on is None
    assert one.exchange(is_on=True, heartbeat=1, within_s=0.1) is True
    assert [request[1] for request in client.asked] == [31, 47, 58, 59]
    assert [request[2] for request in client.asked[2:]] == [{"count": 1, "device_id": MAP.unit}] * 2
    assert one.beam_on is False
    signals[58], signals[59] = signals[59], signals[58]
    assert one.exchange(is_on=True, heartbeat=2, within_s=0.1) is False
    assert one.beam_on is True
    one.close()
    assert one.beam_on is None


def test_without_a_beam_on_input_none_is_read(client):
    one = wire(client)
    one.exchange(is_on=True, heartbeat=1, within_s=0.1)
    assert len(client.asked) == 3
    assert one.beam_on is None


def test_a_beam_on_signal_that_is_refused_fails_the_exchange(client):
    answers = {58: Answer(bits=byte(True)).to(2), 59: Answer(is_refusal=True, exception_code=2)}
    client.read_discrete_inputs = lambda address, **_options: answers[address]
    one = ModbusWire(client, replace(MAP, beam_on_input=59), name="the beam line at test")
    with pytest.raises(BeamLineError, match=r"^it refuses the beam-on signal \(Modbus exception 2\)$"):
        one.exchange(is_on=True, heartbeat=1, within_s=0.1)


@pytest.mark.parametrize(("address", "bound"), [(58, "another input"), (-1, "0 to 65535"), (65_536, "0 to 65535")])
def test_an_address_of_the_beam_on_signal_that_cannot_be_is_refused_by_name(address, bound):
    with pytest.raises(InvalidValueError, match=rf"^beam_on_input .*{bound}"):
        replace(MAP, beam_on_input=address)


def echoing(client):
    """The client of a device that confirms every coil as it is written."""
    client.write_coil = lambda address, value, **options: (
        client._ask("coil", address, value, **options) or Answer(address=address, bits=[value]).to(5)
    )
    return ModbusWire(client, replace(MAP, expected_coil=32), name="the beam line at test")


def coils(client):
    return [request[1:3] for request in client.asked if request[0] == "coil"]


@pytest.mark.parametrize("is_on", [True, False])
def test_a_gate_is_expected_with_every_exchange_and_not_after_the_end(client, is_on):
    one = echoing(client)
    one.exchange(is_on=is_on, heartbeat=1, within_s=0.1)
    assert coils(client) == [(31, is_on), (32, True)], "the permit first"
    one.close()
    assert coils(client)[2:] == [(32, False)]
    assert client.asked[-1] == "close"


def test_a_connection_that_is_gone_is_closed_without_a_word(client):
    one = echoing(client)
    client.connected = False
    one.close()
    client.connected, client.error = True, ModbusException("no response")
    one.close()
    assert client.asked[-1] == "close"


def test_a_device_without_that_coil_fails_the_exchange(client):
    one = ModbusWire(client, replace(MAP, expected_coil=32), name="the beam line at test")
    with pytest.raises(BeamLineError, match=r"something different than was written: that a gate is expected$"):
        one.exchange(is_on=True, heartbeat=1, within_s=0.1)


@pytest.mark.parametrize(("address", "bound"), [(31, "another coil"), (-1, "0 to 65535"), (65_536, "0 to 65535")])
def test_an_address_of_that_coil_that_cannot_be_is_refused_by_name(address, bound):
    with pytest.raises(InvalidValueError, match=rf"^expected_coil .*{bound}"):
        replace(MAP, expected_coil=address)
