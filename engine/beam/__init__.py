"""Beam lines: what permits or holds the beam, by wire or in memory, and what reports whether it is on.

A line is a :class:`BeamLine`: a lease turns it on, a hold turns it off and latches. Real lines are wires
(`ModbusWire`, `RelayWire`) under one supervision (`WiredBeamLine`); two lines are one (`PairedBeamLine`).
"""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.beam.beam_on import (
        ABSENT_BOUNDS_S as ABSENT_BOUNDS_S,
        ABSENT_S as ABSENT_S,
        AFTER_PERMIT_BOUNDS_MS as AFTER_PERMIT_BOUNDS_MS,
        AFTER_PERMIT_MS as AFTER_PERMIT_MS,
        BeamOff as BeamOff,
        BeamOnState as BeamOnState,
        ReadBeamOn as ReadBeamOn,
    )
    from engine.beam.commissioning import (
        PULSE_BOUNDS_MS as PULSE_BOUNDS_MS,
        Pulser as Pulser,
    )
    from engine.beam.compared_line import (
        ComparedBeamLine as ComparedBeamLine,
    )
    from engine.beam.heartbeat_drill import (
        DrilledReceiver as DrilledReceiver,
        HeartbeatDrill as HeartbeatDrill,
        OwnInput as OwnInput,
        SecondInput as SecondInput,
        check_verifiable as check_verifiable,
    )
    from engine.beam.line import (
        BeamLine as BeamLine,
        TroubleListener as TroubleListener,
    )
    from engine.beam.paired import (
        PairedBeamLine as PairedBeamLine,
    )
    from engine.beam.simulated import (
        ACCELERATOR_BOUNDS_MS as ACCELERATOR_BOUNDS_MS,
        SimulatedAccelerator as SimulatedAccelerator,
        SimulatedBeamLine as SimulatedBeamLine,
        SimulatedReceiver as SimulatedReceiver,
    )
    from engine.beam.status.published_line import (
        HttpSender as HttpSender,
        PublishedBeamLine as PublishedBeamLine,
        Sender as Sender,
        StatusPublisher as StatusPublisher,
        UdpSender as UdpSender,
    )
    from engine.beam.wire.line_supervisor import (
        TIME_BOUNDS as TIME_BOUNDS,
        LineTimes as LineTimes,
    )
    from engine.beam.wire.modbus import (
        ModbusInput as ModbusInput,
        ModbusWire as ModbusWire,
        rtu_wire as rtu_wire,
        tcp_wire as tcp_wire,
    )
    from engine.beam.wire.register_map import (
        MAP_BOUNDS as MAP_BOUNDS,
        RegisterMap as RegisterMap,
    )
    from engine.beam.wire.serial_relay import (
        Contact as Contact,
        Protocol as Protocol,
        RelayWire as RelayWire,
        check_channels as check_channels,
    )
    from engine.beam.wire.serial_settings import (
        BAUD_RATES as BAUD_RATES,
        Parity as Parity,
        check_baud as check_baud,
    )
    from engine.beam.wire.supervised_line import (
        Wire as Wire,
        WiredBeamLine as WiredBeamLine,
    )

__getattr__, __all__ = lazy_exports(__name__)
