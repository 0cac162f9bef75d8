"""The addresses of a Modbus device; settings name them without the library that speaks to it."""

from dataclasses import dataclass

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError

MAP_BOUNDS: dict[str, tuple[int, int]] = {
    "unit": (1, 247),
    "permit_coil": (0, 65_535),
    "heartbeat_register": (0, 65_535),
    "readback_input": (0, 65_535),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterMap:
    """Addresses in the device, counted from 0 as on the wire.

    Attributes
    ----------
    unit
        The device's address.
    permit_coil
        Written at every cycle: 1 permits.
    heartbeat_register
        A holding register that counts up at every cycle, 0 to 65535 and from 0 again.
    readback_input
        A discrete input: 1 is a permit that has reached the contact.
    beam_on_input
        A discrete input: 1 is a beam that the accelerator reports on; None where it is not wired.
    expected_coil
        Written with every permit: 1 while the line is in use, 0 when it is closed: a gate is expected. None for none.
    """

    unit: int = 1
    permit_coil: int = 0
    heartbeat_register: int = 0
    readback_input: int = 0
    beam_on_input: int | None = None
    expected_coil: int | None = None

    def __post_init__(self) -> None:
        """Raise InvalidValueError for an address outside `MAP_BOUNDS`, or one address used for two signals."""
        for name, (low, high) in MAP_BOUNDS.items():
            check_whole_number(name, getattr(self, name), low, high)
        if self.beam_on_input is not None:
            check_whole_number("beam_on_input", self.beam_on_input, *MAP_BOUNDS["readback_input"])
            if self.beam_on_input == self.readback_input:
                raise InvalidValueError("beam_on_input", self.beam_on_input, "another input than the read back's")
        if self.expected_coil is not None:
            check_whole_number("expected_coil", self.expected_coil, *MAP_BOUNDS["permit_coil"])
            if self.expected_coil == self.permit_coil:
                raise InvalidValueError("expected_coil", self.expected_coil, "another coil than the permit's")
