"""Settings of the beam line, ``beam_``.

A setting of a line that is not used is refused, because it suggests an output that does not exist.
"""

import re
from typing import Annotated, Literal, Self, TypeAlias
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, field_validator, model_validator
from pydantic_settings import NoDecode

from engine.beam import (
    ABSENT_BOUNDS_S,
    ABSENT_S,
    ACCELERATOR_BOUNDS_MS,
    AFTER_PERMIT_BOUNDS_MS,
    AFTER_PERMIT_MS,
    BAUD_RATES,
    MAP_BOUNDS,
    TIME_BOUNDS,
    Contact,
    LineTimes,
    Parity,
    Protocol,
    RegisterMap,
    check_baud,
    check_channels,
)
from engine.core.errors import InvalidValueError
from service.core.settings.names import PREFIX, Env, In, Section, setting_name

LineKind: TypeAlias = Literal["simulated", "modbus-tcp", "modbus-rtu", "serial-relay", "plug-in"]
Mode: TypeAlias = Literal["research", "clinical"]
PlugInEntry = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9-]*=[0-9a-f]{64}$")]
Targets = Annotated[tuple[str, ...], NoDecode]
MAX_TARGETS = 8
MAX_PLUG_INS = 32
MAX_TARGET_LENGTH = 500
NO_CHANNEL = -1
READBACK = "readback"

MAP = ("beam_modbus_unit", "beam_modbus_permit_coil", "beam_modbus_heartbeat_register", "beam_modbus_readback_input")
TIMES = ("beam_answer_ms", "beam_settle_ms")
COMPARISON = ("beam_without_permit_ms", "beam_absent_s")
BEAM_ON_INPUT = ("beam_on_input", "beam_modbus_expected_coil", *COMPARISON)
USED_BY: dict[LineKind, tuple[str, ...]] = {
    "simulated": ("beam_simulated_accelerator_ms", *COMPARISON),
    "modbus-tcp": ("beam_modbus_host", "beam_modbus_port", *MAP, *TIMES, *BEAM_ON_INPUT),
    "modbus-rtu": (
        "beam_rtu_device",
        "beam_rtu_baud",
        "beam_rtu_parity",
        "beam_rtu_stop_bits",
        *MAP,
        *TIMES,
        *BEAM_ON_INPUT,
    ),
    "serial-relay": (
        "beam_relay_device",
        "beam_relay_baud",
        "beam_relay_protocol",
        "beam_relay_channel",
        "beam_relay_contact",
        "beam_relay_heartbeat_channel",
        "beam_relay_expected_channel",
        *TIMES,
    ),
    "plug-in": ("beam_plug_in", *TIMES),
}
SIGNALS = ("beam_on_input", "beam_modbus_expected_coil", "beam_relay_expected_channel", "beam_simulated_accelerator_ms")
NOT_PLACES = {*TIMES, *SIGNALS, *COMPARISON}
PLACES = {name for names in USED_BY.values() for name in names} - NOT_PLACES
NEEDED_BY: dict[LineKind, str] = {
    "modbus-tcp": "beam_modbus_host",
    "modbus-rtu": "beam_rtu_device",
    "serial-relay": "beam_relay_device",
    "plug-in": "beam_plug_in",
}
SECOND_INPUTS = ("beam_second_input", "beam_second_input_2")
DEVICES = ("beam_rtu_device", "beam_relay_device")


class BeamSettings(Section):
    """Settings of the beam line; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "beam"
    KEY_PREFIX = "beam_"

    mode: Annotated[Env[Mode], In("site")] = Field(
        default="research", description="Clinical mode has narrower bounds; docs/3-operate/clinical.md"
    )
    beam_line: Env[LineKind] = "simulated"
    beam_line_2: Env[LineKind | None] = Field(
        default=None, description="A second line of another kind; the beam is on only if both permit"
    )
    plug_ins: Annotated[tuple[PlugInEntry, ...] | None, In("site")] = Field(
        default=None,
        max_length=MAX_PLUG_INS,
        description="Cameras and beam lines of other distributions that may run, NAME=SHA256 as `tidegate devices "
        "list` prints it; by default every installed one in research, none in clinical mode",
    )
    beam_plug_in: Env[str] = Field(
        default="",
        max_length=MAX_TARGET_LENGTH,
        pattern=r"^([a-z][a-z0-9-]*(:[ -~]*)?)?$",
        description="A beam line of another distribution, NAME or NAME:ADDRESS; the address is the plug-in's",
    )
    hardware_dead_man: Env[bool] = Field(
        default=False,
        description="The site declares a tested device that drops the beam without this computer; in the audit",
    )
    beam_second_input: Env[str] = Field(
        default="",
        max_length=MAX_TARGET_LENGTH,
        description="What shows the contact to the drill of the heartbeat: readback, or HOST:PORT/UNIT/INPUT (Modbus)",
    )
    beam_second_input_2: Env[str] = Field(
        default="", max_length=MAX_TARGET_LENGTH, description="The same for the second line's contact"
    )
    beam_answer_ms: float = Field(
        default=100.0,
        ge=TIME_BOUNDS["answer_ms"][0],
        le=TIME_BOUNDS["answer_ms"][1],
        description="Longest wait for a reply",
    )
    beam_settle_ms: float = Field(
        default=60.0,
        ge=TIME_BOUNDS["settle_ms"][0],
        le=TIME_BOUNDS["settle_ms"][1],
        description="Longest time until the read-back follows",
    )
    beam_modbus_host: Env[str] = Field(default="", max_length=253)
    beam_modbus_port: Env[int] = Field(default=502, ge=1, le=65_535)
    beam_modbus_unit: int = Field(default=1, ge=MAP_BOUNDS["unit"][0], le=MAP_BOUNDS["unit"][1])
    beam_modbus_permit_coil: int = Field(default=0, ge=0, le=65_535)
    beam_modbus_heartbeat_register: int = Field(default=0, ge=0, le=65_535)
    beam_modbus_readback_input: int = Field(default=0, ge=0, le=65_535)
    beam_modbus_expected_coil: int = Field(
        default=NO_CHANNEL,
        ge=NO_CHANNEL,
        le=MAP_BOUNDS["permit_coil"][1],
        description="Coil that is 1 only while a session runs: a gate is expected; -1 is none",
    )
    beam_on_input: Env[int] = Field(
        default=NO_CHANNEL,
        ge=NO_CHANNEL,
        le=MAP_BOUNDS["readback_input"][1],
        description="Discrete input of the accelerator's beam-on signal; -1 is none",
    )
    beam_without_permit_ms: float = Field(
        default=AFTER_PERMIT_MS,
        ge=AFTER_PERMIT_BOUNDS_MS[0],
        le=AFTER_PERMIT_BOUNDS_MS[1],
        description="Longest beam-on after the end of a permit",
    )
    beam_absent_s: float = Field(
        default=ABSENT_S,
        ge=ABSENT_BOUNDS_S[0],
        le=ABSENT_BOUNDS_S[1],
        description="Permitted time without a beam after which it is an alarm",
    )
    beam_simulated_accelerator_ms: int = Field(
        default=NO_CHANNEL,
        ge=NO_CHANNEL,
        le=int(ACCELERATOR_BOUNDS_MS[1]),
        description="Delay of a simulated accelerator behind the simulated line; -1 is none",
    )
    beam_rtu_device: Env[str] = Field(default="", max_length=255)
    beam_rtu_baud: Env[int] = Field(default=19_200, ge=BAUD_RATES[0], le=BAUD_RATES[-1])
    beam_rtu_parity: Parity = "even"
    beam_rtu_stop_bits: int = Field(default=1, ge=1, le=2)
    beam_relay_device: Env[str] = Field(default="", max_length=255)
    beam_relay_baud: int = Field(default=9_600, ge=BAUD_RATES[0], le=BAUD_RATES[-1])
    beam_relay_protocol: Protocol = "lcus"
    beam_relay_channel: int = Field(default=1, ge=0, le=31)
    beam_relay_contact: Contact = Field(default="none", description="Modem line wired to the relay's second contact")
    beam_relay_heartbeat_channel: int = Field(
        default=NO_CHANNEL, ge=NO_CHANNEL, le=31, description="Relay that switches at every cycle; -1 is none"
    )
    beam_relay_expected_channel: int = Field(
        default=NO_CHANNEL, ge=NO_CHANNEL, le=31, description="Relay that is on while a session runs; -1 is none"
    )
    beam_notify_udp: Env[Targets] = Field(default=(), max_length=MAX_TARGETS, description="host:port, comma-separated")
    beam_notify_http: Env[Targets] = Field(default=(), max_length=MAX_TARGETS, description="Addresses, comma-separated")

    @field_validator("beam_notify_udp", "beam_notify_http", mode="before")
    @classmethod
    def _split_targets(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("beam_notify_udp")
    @classmethod
    def _are_udp_targets(cls, targets: tuple[str, ...]) -> tuple[str, ...]:
        for target in targets:
            udp_target(target)
        return targets

    @field_validator("beam_notify_http")
    @classmethod
    def _are_http_targets(cls, targets: tuple[str, ...]) -> tuple[str, ...]:
        for target in targets:
            _check_http_target(target)
        return targets

    @field_validator("beam_rtu_baud", "beam_relay_baud")
    @classmethod
    def _is_baud(cls, baud: int) -> int:
        try:
            check_baud(baud)
        except InvalidValueError as error:
            msg = f"{baud} must be {error.bound}"
            raise ValueError(msg) from error
        return baud

    @model_validator(mode="after")
    def _is_one_line(self) -> Self:
        self._refuse_second_line()
        self._refuse_unused()
        self._refuse_missing()
        self._refuse_out_of_bounds()
        self._refuse_second_inputs()
        return self

    @property
    def beam_lines(self) -> tuple[LineKind, ...]:
        """Kinds of the lines in use, one or two."""
        return (self.beam_line,) if self.beam_line_2 is None else (self.beam_line, self.beam_line_2)

    @property
    def second_inputs(self) -> tuple[str, ...]:
        """What shows the contact of each line in use to the drill of the heartbeat; empty where nothing does."""
        return tuple(getattr(self, name) for name in SECOND_INPUTS[: len(self.beam_lines)])

    @property
    def is_simulated_beam(self) -> bool:
        """Whether the line is a simulation; one is never used beside a real one."""
        return "simulated" in self.beam_lines

    @property
    def has_real_beam(self) -> bool:
        """Whether any line has a physical output."""
        return any(kind != "simulated" for kind in self.beam_lines)

    @property
    def beam_place(self) -> dict[str, str | int]:
        """Kinds and addresses of the lines in use."""
        where = {name: getattr(self, name) for kind in self.beam_lines for name in USED_BY[kind] if name in PLACES}
        seen_by = {name: place for name in SECOND_INPUTS if (place := getattr(self, name))}
        seen_by |= {name: place for name in SIGNALS if (place := getattr(self, name)) != NO_CHANNEL}
        return {"beam_lines": " ".join(self.beam_lines), **where, **seen_by}

    @property
    def allowed_plug_ins(self) -> dict[str, str] | None:
        """Name and SHA-256 of each plug-in that may run; None where every installed one may."""
        if self.plug_ins is None:
            return {} if self.mode == "clinical" else None
        return dict(one.split("=", 1) for one in self.plug_ins)

    @property
    def beam_times(self) -> LineTimes:
        """Time limits of a wired line."""
        return LineTimes(answer_ms=self.beam_answer_ms, settle_ms=self.beam_settle_ms)

    def beam_registers(self, kind: LineKind, *, is_session: bool = False) -> RegisterMap:
        """Register map of the Modbus device of a line; in a session the gate is expected, in QA it is not."""
        is_expected = is_session and self.beam_modbus_expected_coil != NO_CHANNEL
        return RegisterMap(
            expected_coil=self.beam_modbus_expected_coil if is_expected else None,
            beam_on_input=self.beam_on_input if kind == self.beam_on_line != "simulated" else None,
            unit=self.beam_modbus_unit,
            permit_coil=self.beam_modbus_permit_coil,
            heartbeat_register=self.beam_modbus_heartbeat_register,
            readback_input=self.beam_modbus_readback_input,
        )

    @property
    def beam_on_line(self) -> LineKind | None:
        """The line that reads the accelerator's signal, the first that can; None where there is no signal."""
        if self.is_simulated_beam:
            return None if self.beam_simulated_accelerator_ms == NO_CHANNEL else "simulated"
        modbus: list[LineKind] = [kind for kind in self.beam_lines if "beam_on_input" in USED_BY[kind]]
        return modbus[0] if modbus and self.beam_on_input != NO_CHANNEL else None

    @property
    def beam_heartbeat_channel(self) -> int | None:
        """The relay that carries the heartbeat, if any."""
        return None if self.beam_relay_heartbeat_channel == NO_CHANNEL else self.beam_relay_heartbeat_channel

    @property
    def beam_expected_channel(self) -> int | None:
        """The relay that says that a gate is expected, if any."""
        return None if self.beam_relay_expected_channel == NO_CHANNEL else self.beam_relay_expected_channel

    def _refuse_second_line(self) -> None:
        if self.beam_line_2 is not None and self.is_simulated_beam:
            msg = (
                f"{PREFIX}BEAM_LINE_2 is {self.beam_line_2} beside {self.beam_line}: a simulated line cannot be "
                "combined with a real one, because its sessions are labelled as simulated"
            )
            raise ValueError(msg)
        if self.hardware_dead_man and not self.has_real_beam:
            msg = f"{PREFIX}HARDWARE_DEAD_MAN is true, but the beam line is simulated: there is no beam to drop"
            raise ValueError(msg)
        if self.beam_line == self.beam_line_2:
            msg = f"{PREFIX}BEAM_LINE_2 must be of another kind than {PREFIX}BEAM_LINE ({self.beam_line})"
            raise ValueError(msg)

    def _refuse_unused(self) -> None:
        used = {name for kind in self.beam_lines for name in USED_BY[kind]}
        known = {name for names in USED_BY.values() for name in names}
        if self.beam_on_line is None:
            used -= set(COMPARISON)
        for name in sorted((known & self.model_fields_set) - used):
            msg = f"{setting_name(name)} is set, but {_unused(name, self.beam_lines)}"
            raise ValueError(msg)

    def _refuse_missing(self) -> None:
        for kind in self.beam_lines:
            needed = NEEDED_BY.get(kind)
            if needed is not None and not getattr(self, needed):
                msg = f"{setting_name(needed)} is needed by the beam line {kind}"
                raise ValueError(msg)
        for name in DEVICES:
            device = getattr(self, name)
            if device and not device.startswith("/"):
                msg = f"{setting_name(name)} must be the path of a serial port, like /dev/ttyUSB0"
                raise ValueError(msg)

    def _refuse_second_inputs(self) -> None:
        for number, name in enumerate(SECOND_INPUTS):
            place = getattr(self, name)
            kind = self.beam_lines[number] if number < len(self.beam_lines) else None
            if not place:
                continue
            if kind is None or kind == "simulated":
                used = ", ".join(self.beam_lines)
                msg = f"{setting_name(name)} is set, but there is no such wired line ({used} is used)"
                raise ValueError(msg)
            if place != READBACK:
                _check_second_input(name, place)
            elif kind == "serial-relay" and self.beam_relay_contact == "none":
                msg = f"{setting_name(name)} is {READBACK}: set beam.relay_contact, or name another device's input"
                raise ValueError(msg)

    def _refuse_out_of_bounds(self) -> None:
        try:
            _ = self.beam_times
            for kind in self.beam_lines:
                self.beam_registers(kind)
            if "serial-relay" in self.beam_lines:
                check_channels(
                    self.beam_relay_protocol,
                    self.beam_relay_channel,
                    self.beam_heartbeat_channel,
                    self.beam_expected_channel,
                )
        except InvalidValueError as error:
            name = error.field if error.field.startswith("beam_") else f"beam_{error.field}"
            name = name if name in type(self).model_fields else f"beam_relay_{error.field}"
            msg = f"{setting_name(name)} must be {error.bound}"
            raise ValueError(msg) from error


def second_input_place(text: str) -> tuple[str, int, RegisterMap]:
    """Parse ``HOST:PORT/UNIT/INPUT`` into host, port and map; raise ValueError."""
    parts = urlsplit(f"//{text}")
    host, port, numbers = parts.hostname, parts.port, parts.path.split("/")[1:]
    is_plain = parts.username is None and not parts.query and not parts.fragment and "\\" not in text
    if (
        not host
        or not port
        or not is_plain
        or len(numbers) != 2
        or not all(re.fullmatch("[0-9]{1,5}", n) for n in numbers)
    ):
        msg = f"must be {READBACK}, or HOST:PORT/UNIT/INPUT"  # without the value, which may hold a password
        raise ValueError(msg)
    try:
        return host, port, RegisterMap(unit=int(numbers[0]), readback_input=int(numbers[1]))
    except InvalidValueError as error:
        msg = f"{'UNIT' if error.field == 'unit' else 'INPUT'} is {error.value}: must be {error.bound}"
        raise ValueError(msg) from error


def udp_target(target: str) -> tuple[str, int]:
    """Parse ``host:port``; raise ValueError."""
    parts = urlsplit(f"//{target}")
    host, port = parts.hostname, parts.port  # a port out of its bound is a ValueError of its own
    if not host or not port or parts.path or parts.username is not None or len(target) > MAX_TARGET_LENGTH:
        msg = f"{target[:80]!r} must be host:port"
        raise ValueError(msg)
    return host, port


def _check_second_input(name: str, place: str) -> None:
    try:
        second_input_place(place)
    except ValueError as error:
        msg = f"{setting_name(name)}: {error}"
        raise ValueError(msg) from error


def _check_http_target(target: str) -> None:
    parts = urlsplit(target)
    _ = parts.port
    is_plain = parts.scheme in {"http", "https"} and parts.hostname and parts.username is None and not parts.fragment
    if not is_plain or len(target) > MAX_TARGET_LENGTH or any(sign.isspace() for sign in target):
        address = "http://host/path or https://host/path"
        msg = f"a target must be {address}, without a password, of at most {MAX_TARGET_LENGTH} characters"
        raise ValueError(msg)


def _unused(name: str, lines: tuple[LineKind, ...]) -> str:
    if name in COMPARISON:
        return f"neither {setting_name(SIGNALS[0])} nor {setting_name(SIGNALS[1])} is"
    users = [kind for kind, names in USED_BY.items() if name in names]
    return f"no beam line is {' or '.join(users)} ({', '.join(lines)} is used)"
