"""Builds the beam line that a site's settings name.

What two services of one machine must not share: a Modbus coil or heartbeat register, a serial port, a camera.

Each target in use is an abstract socket of this machine, bound to its name: the kernel lets one process have it,
whatever its user and data folder, and frees it when that process ends, however it ends. Containers share these names
where they share the host's network, as docker/room does.
"""

import hashlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from typing import TypeAlias

from engine import beam
from engine.beam import (
    BeamLine,
    BeamOnState,
    ComparedBeamLine,
    DrilledReceiver,
    HttpSender,
    OwnInput,
    PairedBeamLine,
    PublishedBeamLine,
    ReadBeamOn,
    RelayWire,
    SecondInput,
    Sender,
    SimulatedAccelerator,
    SimulatedBeamLine,
    SimulatedReceiver,
    StatusPublisher,
    UdpSender,
    Wire,
    WiredBeamLine,
)
from engine.core.clock import Clock
from engine.core.errors import TidegateError
from engine.core.plug_ins import BEAM_LINES, PlugInError, find_plug_in
from service.core.settings.beam import READBACK, BeamSettings, LineKind, second_input_place, udp_target
from service.core.settings.settings import Settings

LinePart: TypeAlias = SimulatedBeamLine | WiredBeamLine
NOTIFY_TIMEOUT_S = 1.0
"""Longest wait for a receiver of status messages."""
PREFIX = b"\0tidegate-target-"


def make_beam_line(settings: BeamSettings, clock: Clock) -> BeamLine:
    """Return the beam line, not yet open: one or two lines, with publisher and beam-on signal if they are set."""
    parts = beam_line_parts(settings, clock, is_session=True)
    line = published(joined(parts), settings, clock)
    read = read_beam_on(settings, clock, parts)
    if read is None:
        return line
    return ComparedBeamLine(
        line, clock, read, after_permit_ms=settings.beam_without_permit_ms, absent_s=settings.beam_absent_s
    )


def read_beam_on(settings: BeamSettings, clock: Clock, parts: Sequence[LinePart]) -> ReadBeamOn | None:
    """Return what reads the accelerator's signal by one of the parts; None where there is no signal."""
    if settings.beam_on_line is None:
        return None
    part = parts[settings.beam_lines.index(settings.beam_on_line)]
    if isinstance(part, SimulatedBeamLine):
        return SimulatedAccelerator(part, clock, delay_ms=settings.beam_simulated_accelerator_ms).read
    wire = part.wire
    assert isinstance(wire, beam.ModbusWire), "only a Modbus line has a beam-on input"
    return lambda: wire.beam_on


def beam_on_state(line: BeamLine) -> BeamOnState | None:
    """Return what the comparison with the accelerator's signal knows; None where nothing is compared."""
    return line.state if isinstance(line, ComparedBeamLine) else None


def published(line: BeamLine, settings: BeamSettings, clock: Clock) -> BeamLine:
    """Add the status publisher to a line, if one is set."""
    senders = _senders(settings)
    if not senders:
        return line
    return PublishedBeamLine(line, [StatusPublisher(sender, clock, utc_now=_utc_now) for sender in senders], clock)


def beam_line_parts(settings: BeamSettings, clock: Clock, *, is_session: bool = False) -> tuple[LinePart, ...]:
    """Return the one or two lines that the settings name, separately; a session's say that a gate is expected."""
    places = settings.second_inputs
    return tuple(
        _line(kind, settings, clock, place, is_session=is_session)
        for kind, place in zip(settings.beam_lines, places, strict=True)
    )


def joined(parts: Sequence[BeamLine]) -> BeamLine:
    """Make one line of one or two."""
    return parts[0] if len(parts) == 1 else PairedBeamLine(*parts)


def drilled_receivers(settings: BeamSettings, clock: Clock, parts: Sequence[LinePart]) -> tuple[DrilledReceiver, ...]:
    """Return the receiver of each part, with the second input that the settings name."""
    return tuple(
        DrilledReceiver(name=kind, line=part, second_input=_second_input(kind, settings, clock, part, place))
        for kind, part, place in zip(settings.beam_lines, parts, settings.second_inputs, strict=True)
    )


def _second_input(
    kind: LineKind, settings: BeamSettings, clock: Clock, part: LinePart, place: str
) -> SecondInput | None:
    if isinstance(part, SimulatedBeamLine):
        return SimulatedReceiver(part, clock)
    if not place:
        return None
    if place != READBACK:
        host, port, registers = second_input_place(place)
        return beam.ModbusInput(beam.tcp_wire(host=host, port=port, registers=registers))
    return beam.ModbusInput(_tcp(settings)) if kind == "modbus-tcp" else OwnInput(part)


def _line(kind: LineKind, settings: BeamSettings, clock: Clock, place: str, *, is_session: bool) -> LinePart:
    if kind == "simulated":
        return SimulatedBeamLine(clock)
    wire = WIRES[kind](settings, is_session)
    looks_itself = place == READBACK and kind != "modbus-tcp"
    look = getattr(wire, "look", None) if looks_itself else None
    return WiredBeamLine(wire, clock, settings.beam_times, look=look)


def _tcp(settings: BeamSettings, is_session: bool = False) -> "beam.ModbusWire":  # noqa: FBT001, FBT002 - in a table
    registers = settings.beam_registers("modbus-tcp", is_session=is_session)
    return beam.tcp_wire(host=settings.beam_modbus_host, port=settings.beam_modbus_port, registers=registers)


def _rtu(settings: BeamSettings, is_session: bool) -> "beam.ModbusWire":  # noqa: FBT001 - in a table
    return beam.rtu_wire(
        device=settings.beam_rtu_device,
        baud=settings.beam_rtu_baud,
        parity=settings.beam_rtu_parity,
        stop_bits=settings.beam_rtu_stop_bits,
        registers=settings.beam_registers("modbus-rtu", is_session=is_session),
    )


def _plugged(settings: BeamSettings, is_session: bool) -> Wire:  # noqa: ARG001, FBT001 - in a table
    """Make the wire of a plug-in; supervision, lease and read-back are those of every line.

    Raises
    ------
    PlugInError
        It is not installed, not allowed, or makes no `Wire`.
    """
    name, _, address = settings.beam_plug_in.partition(":")
    plug_in = find_plug_in(BEAM_LINES, name, settings.allowed_plug_ins)
    make = plug_in.load()
    try:
        wire: Wire = make(address)  # type: ignore[operator]
    except Exception as error:
        msg = f"the beam line {name} ({plug_in.label}) refuses {address!r}: {type(error).__name__}: {error}"
        raise PlugInError(msg) from error
    missing = [one for one in vars(Wire) if not one.startswith("_") and not hasattr(wire, one)]
    if missing:
        msg = f"the beam line {name} ({plug_in.label}) lacks {', '.join(missing)}"
        raise PlugInError(msg)
    return wire


def _relay(settings: BeamSettings, is_session: bool) -> RelayWire:  # noqa: FBT001 - in a table
    return RelayWire(
        device=settings.beam_relay_device,
        baud=settings.beam_relay_baud,
        protocol=settings.beam_relay_protocol,
        channel=settings.beam_relay_channel,
        contact=settings.beam_relay_contact,
        heartbeat_channel=settings.beam_heartbeat_channel,
        expected_channel=settings.beam_expected_channel if is_session else None,
    )


WIRES: dict[LineKind, Callable[[BeamSettings, bool], Wire]] = {
    "modbus-tcp": _tcp,
    "modbus-rtu": _rtu,
    "serial-relay": _relay,
    "plug-in": _plugged,
}


def _senders(settings: BeamSettings) -> list[Sender]:
    over_udp = [UdpSender(*udp_target(target)) for target in settings.beam_notify_udp]
    over_http = [HttpSender(url, timeout_s=NOTIFY_TIMEOUT_S) for url in settings.beam_notify_http]
    return [*over_udp, *over_http]


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class TargetInUseError(TidegateError):
    """Another Tidegate program of this machine uses the same coil, register, port or camera."""


@contextmanager
def alone_at_targets(settings: Settings) -> Iterator[None]:
    """Have the beam lines and the camera of the settings for oneself; raise TargetInUseError where another has one."""
    with ExitStack() as held:
        for target in targets_of(settings):
            _hold(held, target)
        yield


def targets_of(settings: Settings) -> tuple[str, ...]:
    """Return the names of what this service drives; nothing for a simulated line.

    The heartbeat register is a target of its own: two services that share it would keep each other's permit alive, also
    where their coils differ.
    """
    found: list[str] = []
    if "modbus-tcp" in settings.beam_lines:
        unit = f"{settings.beam_modbus_port}/{settings.beam_modbus_unit}"
        for host in _addresses(settings.beam_modbus_host):
            found += [
                f"Modbus coil {host}:{unit}/{settings.beam_modbus_permit_coil}",
                f"Modbus heartbeat register {host}:{unit}/{settings.beam_modbus_heartbeat_register}",
            ]
    if "modbus-rtu" in settings.beam_lines:
        found.append(f"serial port {_device(settings.beam_rtu_device)}")
    if "serial-relay" in settings.beam_lines:
        found.append(f"serial port {_device(settings.beam_relay_device)}")
    if "plug-in" in settings.beam_lines:
        found.append(f"beam line {settings.beam_plug_in}")
    if settings.camera_uri:
        found.append(f"camera {settings.camera_uri}")
    return tuple(found)


def _addresses(host: str) -> list[str]:
    """Return the host as written and its addresses, so that a name and an address of one device are the same."""
    written = host.casefold().rstrip(".")
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError:
        return [written]
    return sorted({written, *(str(one[4][0]) for one in found)})


def _device(path: str) -> str:
    """Return a port's device number, which all its names share; the path where there is no such device now."""
    try:
        number = os.stat(path).st_rdev  # noqa: PTH116 - of the device, not of the link that names it
    except OSError:
        return path
    return f"{os.major(number)}:{os.minor(number)}" if number else os.path.realpath(path)


def _hold(held: ExitStack, target: str) -> None:
    one = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    try:
        one.bind(PREFIX + hashlib.sha256(target.encode()).hexdigest().encode())
    except OSError as error:
        msg = f"{target} is in use by another Tidegate program of this machine: one room, one machine"
        raise TargetInUseError(msg) from error
