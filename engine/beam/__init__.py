"""Beam lines: what permits or holds the beam, by wire or in memory, and what reports whether it is on.

A line is a :class:`BeamLine`: a lease turns it on, a hold turns it off and latches. Real lines are wires
(`ModbusWire`, `RelayWire`) under one supervision (`WiredBeamLine`); two lines are one (`PairedBeamLine`).
"""

from engine.beam.beam_on import (
    ABSENT_BOUNDS_S,
    ABSENT_S,
    AFTER_PERMIT_BOUNDS_MS,
    AFTER_PERMIT_MS,
    BeamOff,
    BeamOnState,
    ReadBeamOn,
)
from engine.beam.commissioning import (
    PULSE_BOUNDS_MS,
    Pulser,
)
from engine.beam.compared_line import (
    ComparedBeamLine,
)
from engine.beam.heartbeat_drill import (
    DrilledReceiver,
    HeartbeatDrill,
    OwnInput,
    SecondInput,
    check_verifiable,
)
from engine.beam.line import (
    BeamLine,
    TroubleListener,
)
from engine.beam.paired import (
    PairedBeamLine,
)
from engine.beam.simulated import (
    ACCELERATOR_BOUNDS_MS,
    SimulatedAccelerator,
    SimulatedBeamLine,
    SimulatedReceiver,
)
from engine.beam.status.published_line import (
    HttpSender,
    PublishedBeamLine,
    Sender,
    StatusPublisher,
    UdpSender,
)
from engine.beam.wire.line_supervisor import (
    TIME_BOUNDS,
    LineTimes,
)
from engine.beam.wire.modbus import (
    MAP_BOUNDS,
    ModbusInput,
    ModbusWire,
    RegisterMap,
    rtu_wire,
    tcp_wire,
)
from engine.beam.wire.serial_relay import (
    Contact,
    Protocol,
    RelayWire,
    check_channels,
)
from engine.beam.wire.serial_settings import (
    BAUD_RATES,
    Parity,
    check_baud,
)
from engine.beam.wire.supervised_line import (
    Wire,
    WiredBeamLine,
)

__all__ = [
    "ABSENT_BOUNDS_S",
    "ABSENT_S",
    "ACCELERATOR_BOUNDS_MS",
    "AFTER_PERMIT_BOUNDS_MS",
    "AFTER_PERMIT_MS",
    "BAUD_RATES",
    "MAP_BOUNDS",
    "PULSE_BOUNDS_MS",
    "TIME_BOUNDS",
    "BeamLine",
    "BeamOff",
    "BeamOnState",
    "ComparedBeamLine",
    "Contact",
    "DrilledReceiver",
    "HeartbeatDrill",
    "HttpSender",
    "LineTimes",
    "ModbusInput",
    "ModbusWire",
    "OwnInput",
    "PairedBeamLine",
    "Parity",
    "Protocol",
    "PublishedBeamLine",
    "Pulser",
    "ReadBeamOn",
    "RegisterMap",
    "RelayWire",
    "SecondInput",
    "Sender",
    "SimulatedAccelerator",
    "SimulatedBeamLine",
    "SimulatedReceiver",
    "StatusPublisher",
    "TroubleListener",
    "UdpSender",
    "Wire",
    "WiredBeamLine",
    "check_baud",
    "check_channels",
    "check_verifiable",
    "rtu_wire",
    "tcp_wire",
]
