"""Two programs of one machine never drive one coil, one heartbeat register or one serial port, nor share a camera."""

import os
import socket
import subprocess
import sys
import tty

import pytest

from service.core.settings.settings import Settings
from service.engine_host import beam_lines
from service.engine_host.beam_lines import TargetInUseError, alone_at_targets, targets_of
from service.engine_host.local_engine import LocalEngine
from tests.support.capture.fake_driver import FakeDriver, use
from tests.support.site_settings import with_config

HOLDER = """
import os, sys
from service.core.settings.settings import Settings
from service.engine_host.beam_lines import alone_at_targets
with alone_at_targets(Settings()):
    print("held", flush=True)
    sys.stdin.read()
"""


def modbus(**changes):
    values = {"beam_modbus_host": "127.0.0.1", "beam_modbus_permit_coil": 3, "beam_modbus_heartbeat_register": 11}
    return Settings(beam_line="modbus-tcp", **(values | changes))


def is_refused(settings):
    try:
        with alone_at_targets(settings):
            return False
    except TargetInUseError:
        return True


@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({}, True),
        ({"beam_modbus_host": "localhost"}, True),
        ({"beam_modbus_heartbeat_register": 12}, True),
        ({"beam_modbus_permit_coil": 4}, True),  # the other's heartbeat would keep this permit alive
        ({"beam_modbus_permit_coil": 4, "beam_modbus_heartbeat_register": 12}, False),
        ({"beam_modbus_unit": 2}, False),
        ({"beam_modbus_port": 503}, False),
        ({"beam_modbus_host": "127.0.0.2"}, False),
        ({"beam_modbus_readback_input": 5}, True),
    ],
    ids=str,
)
def test_a_coil_and_a_heartbeat_register_are_driven_by_one_program(changes, refused):
    with alone_at_targets(modbus()):
        assert is_refused(modbus(**changes)) is refused
    assert not is_refused(modbus(**changes))


def test_a_name_that_cannot_be_resolved_is_a_target_as_it_is_written(monkeypatch):
    def fails(*_arguments, **_options):
        raise socket.gaierror

    monkeypatch.setattr(beam_lines.socket, "getaddrinfo", fails)
    with alone_at_targets(modbus(beam_modbus_host="PLC.example")):
        assert is_refused(modbus(beam_modbus_host="plc.example."))
        assert not is_refused(modbus(beam_modbus_host="plc2.example"))


def test_the_refusal_names_what_is_in_use():
    bound = r"Modbus coil 127\.0\.0\.1:502/1/3 is in use by another Tidegate program of this machine"
    with alone_at_targets(modbus()), pytest.raises(TargetInUseError, match=bound), alone_at_targets(modbus()):
        pytest.fail("two have it")


def test_a_refused_start_keeps_nothing_of_what_it_had_taken():
    with alone_at_targets(modbus(beam_modbus_permit_coil=9)):
        assert is_refused(modbus(camera_uri="1d27/0609@1"))  # the coil is free, the register is not
    assert not is_refused(modbus(camera_uri="1d27/0609@1"))


def test_a_serial_port_is_one_under_all_its_names(tmp_path):
    master, slave = os.openpty()
    tty.setraw(slave)
    (tmp_path / "beam").symlink_to(os.ttyname(slave))
    relay = {"beam_line": "serial-relay", "beam_relay_device": os.ttyname(slave)}
    try:
        with alone_at_targets(Settings(**relay)):
            assert is_refused(Settings(beam_line="modbus-rtu", beam_rtu_device=str(tmp_path / "beam")))
            assert not is_refused(Settings(beam_line="modbus-rtu", beam_rtu_device=str(tmp_path / "other")))
    finally:
        os.close(master)
        os.close(slave)


def test_a_camera_of_the_setting_is_one_room_s_and_a_simulated_line_is_no_one_s():
    assert targets_of(Settings()) == ()
    with alone_at_targets(Settings(camera_uri="1d27/0609@1")):
        assert is_refused(Settings(camera_uri="1d27/0609@1"))
        assert not is_refused(Settings(camera_uri="1d27/0609@2"))
        assert not is_refused(Settings())


def test_another_process_with_another_folder_is_refused_until_the_first_is_killed(monkeypatch, tmp_path):
    given = {
        "TIDEGATE_BEAM_LINE": "modbus-tcp",
        "TIDEGATE_BEAM_MODBUS_HOST": "127.0.0.1",
        "TIDEGATE_BEAM_MODBUS_PERMIT_COIL": "3",
        "TIDEGATE_BEAM_MODBUS_HEARTBEAT_REGISTER": "11",
        "TIDEGATE_DATA_DIR": str(tmp_path),
    }
    environment = os.environ | with_config(given, tmp_path)
    command = [sys.executable, "-c", HOLDER]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout.readline() == "held\n"
        assert is_refused(modbus())
        process.kill()
        process.wait()
        assert not is_refused(modbus())


def test_only_the_room_s_camera_is_offered(monkeypatch):
    use(monkeypatch, FakeDriver(["1d27/0609@1/4", "1d27/0609@2/7"]))
    offered = LocalEngine(Settings(camera_uri="1d27/0609@2")).devices()
    assert [device.uri for device in offered.items] == ["1d27/0609@2/7"]
