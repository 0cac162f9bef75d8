"""Builds the beam line that a site's settings name."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from engine.beam.line import BeamLine
from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.beam.status.published_line import PublishedBeamLine
from engine.beam.status.publisher import HttpSender, Sender, StatusPublisher, UdpSender
from engine.beam.wire.modbus import rtu_wire, tcp_wire
from engine.beam.wire.serial_relay import RelayWire
from engine.beam.wire.supervised_line import Wire, WiredBeamLine
from engine.core.clock import Clock
from service.core.settings.beam import BeamSettings, LineKind, udp_target


def make_beam_line(settings: BeamSettings, clock: Clock) -> BeamLine:
    """Return the beam line, not yet open: one or two lines, with its status publisher if one is set."""
    line = joined(beam_line_parts(settings, clock))
    senders = _senders(settings)
    if not senders:
        return line
    return PublishedBeamLine(line, [StatusPublisher(sender, clock, utc_now=_utc_now) for sender in senders], clock)


def beam_line_parts(settings: BeamSettings, clock: Clock) -> tuple[SimulatedBeamLine | WiredBeamLine, ...]:
    """Return the one or two lines that the settings name, separately."""
    return tuple(_line(kind, settings, clock) for kind in settings.beam_lines)


def joined(parts: Sequence[BeamLine]) -> BeamLine:
    """Make one line of one or two."""
    return parts[0] if len(parts) == 1 else PairedBeamLine(*parts)


def _line(kind: LineKind, settings: BeamSettings, clock: Clock) -> SimulatedBeamLine | WiredBeamLine:
    if kind == "simulated":
        return SimulatedBeamLine(clock)
    return WiredBeamLine(WIRES[kind](settings), clock, settings.beam_times)


def _tcp(settings: BeamSettings) -> Wire:
    return tcp_wire(host=settings.beam_modbus_host, port=settings.beam_modbus_port, registers=settings.beam_registers)


def _rtu(settings: BeamSettings) -> Wire:
    return rtu_wire(
        device=settings.beam_rtu_device,
        baud=settings.beam_rtu_baud,
        parity=settings.beam_rtu_parity,
        stop_bits=settings.beam_rtu_stop_bits,
        registers=settings.beam_registers,
    )


def _relay(settings: BeamSettings) -> Wire:
    return RelayWire(
        device=settings.beam_relay_device,
        baud=settings.beam_relay_baud,
        protocol=settings.beam_relay_protocol,
        channel=settings.beam_relay_channel,
        contact=settings.beam_relay_contact,
        heartbeat_channel=settings.beam_heartbeat_channel,
    )


WIRES: dict[LineKind, Callable[[BeamSettings], Wire]] = {
    "modbus-tcp": _tcp,
    "modbus-rtu": _rtu,
    "serial-relay": _relay,
}


def _senders(settings: BeamSettings) -> list[Sender]:
    over_udp = [UdpSender(*udp_target(target)) for target in settings.beam_notify_udp]
    over_http = [HttpSender(url, timeout_s=settings.beam_notify_timeout_s) for url in settings.beam_notify_http]
    return [*over_udp, *over_http]


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
