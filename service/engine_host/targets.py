"""What two services of one machine must not share: a Modbus coil or heartbeat register, a serial port, a camera.

Each target in use is an abstract socket of this machine, bound to its name: the kernel lets one process have it,
whatever its user and data folder, and frees it when that process ends, however it ends. Containers share these names
where they share the host's network, as docker/room does.
"""

import hashlib
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from engine.core.errors import TidegateError
from service.core.settings.settings import Settings

PREFIX = b"\0tidegate-target-"


class TargetInUseError(TidegateError):
    """Another Tidegate program of this machine uses the same coil, register, port or camera."""

    code = "target_in_use"


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
