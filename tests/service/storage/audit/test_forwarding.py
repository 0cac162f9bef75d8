"""The audit reaches a real syslog daemon over TLS: whole, in order, once, whatever breaks down in between."""

import re
import signal
import subprocess
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from pydantic import ValidationError

from engine.core.clock import NS_PER_S, ManualClock
from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import Event, verification
from service.storage.audit.formats.dicom import Source
from service.storage.audit.forwarding import forwarder as forwarding
from service.storage.audit.forwarding.forwarder import FAILED, RESUMED, AuditForwarder, PositionFile
from service.storage.audit.forwarding.syslog import SyslogConnection, SyslogServer
from tests.support.audit.rows import fill
from tests.support.audit.supervised_audit import SupervisedAudit
from tests.support.audit.syslog_certificates import Authority
from tests.support.audit.syslog_server import SyslogDaemon
from tests.support.waiting import eventually

SCHEMA = Path(__file__).with_name("audit_message.rng")
HEADER = re.compile(rb"^<85>1 \S+Z \S+ tidegate \d+ DICOM\+RFC3881 - \xef\xbb\xbf(<\?xml.*)$", re.DOTALL)
ROW = re.compile(rb'ParticipantObjectID="(\d+)" ParticipantObjectTypeCode="2" ParticipantObjectTypeCodeRole="13"')


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    return Authority(tmp_path_factory.mktemp("ca"), "ca")


@pytest.fixture(scope="module")
def our_pair(authority):
    return authority.pair("tidegate.test")


@pytest.fixture
def daemon(tmp_path, authority):
    daemon = SyslogDaemon(tmp_path, ca_file=authority.file, pair=authority.pair("localhost")).start()
    yield daemon
    daemon.stop(signal.SIGKILL)


class Desk:
    """A forwarder that goes one turn at a time, on a clock that goes on request."""

    def __init__(self, database, daemon, tmp_path, *, ca_file, pair):
        self.database, self.daemon, self.clock = database, daemon, ManualClock(NS_PER_S)
        self._server = SyslogServer(
            host="localhost",
            port=daemon.port,
            ca_file=ca_file,
            timeout_s=5.0,
            cert_file=None if pair is None else pair.cert,
            key_file=None if pair is None else pair.key,
        )
        self._positions = PositionFile(tmp_path / "forwarded.json")
        self.all_made = []
        self.forwarder = self.made()

    def made(self):
        self.forwarder = AuditForwarder(
            database=self.database,
            connect=lambda: SyslogConnection(self._server, self.clock),
            positions=self._positions,
            source=Source(host_name="gate-1", site="Ward 7"),
            clock=self.clock,
            write=self.write,
            after=0,
        )
        self.all_made.append(self.forwarder)
        return self.forwarder

    def write(self, event):
        with self.database.write() as db:
            audit.append(db, event)

    def turns(self, number=6):
        return [self.forwarder.turn() for _ in range(number)]

    def settle(self):
        self.clock.advance_ns(2 * NS_PER_S)
        self.turns(1)

    @property
    def position(self):
        found = self._positions.read()
        return None if found is None else found.sequence

    def actions(self):
        with self.database.read() as db:
            return [link.action for link in verification.read_links(db, None, 1000)]


@pytest.fixture
def desk(database, daemon, tmp_path, authority, our_pair):
    desk = Desk(database, daemon, tmp_path, ca_file=authority.file, pair=our_pair)
    yield desk
    for forwarder in desk.all_made:
        forwarder._drop()


def received(daemon, rows, *, within_s=5.0):
    """Wait until the daemon has written a row, then give all it has."""

    def found():
        return [int(row.group(1)) for message in daemon.messages() if (row := ROW.search(message)) is not None]

    eventually(lambda: rows in found(), within_s=within_s, detail=lambda: f"row {rows} has not come: {found()}")
    return found()


def test_every_row_comes_in_order_and_is_a_message_as_the_standard_asks(desk, daemon, tmp_path):
    desk.write(Event(actor="A. Nurse <x>", action="user.login", detail={"roles": ["therapist"], "on_behalf_of": "B"}))
    desk.write(
        Event(
            actor="tidegate",
            action="session.arm",
            outcome="refused",
            session_id="5" * 32,
            detail={"message": "\x01 & no"},
        )
    )
    desk.turns()
    assert received(daemon, 9) == list(range(1, 10))
    bodies = [HEADER.match(message).group(1) for message in daemon.messages()]
    files = []
    for number, body in enumerate(bodies):
        files.append(tmp_path / f"message{number}.xml")
        files[-1].write_bytes(body)
    judged = subprocess.run(
        ["xmllint", "--noout", "--relaxng", SCHEMA, *files], capture_output=True, text=True, check=False
    )
    assert judged.returncode == 0, judged.stderr
    login = ET.fromstring(bodies[7])
    assert login.find("EventIdentification/EventID").get("csd-code") == "110114"
    assert [one.get("csd-code") for one in login.iter("EventTypeCode")] == ["110122", "user.login"]
    assert [one.get("UserID") for one in login.iter("ActiveParticipant")] == ["A. Nurse <x>", "B", "tidegate"]
    assert login.find("ActiveParticipant/RoleIDCode").get("csd-code") == "therapist"
    refused = ET.fromstring(bodies[8]).find("EventIdentification")
    assert refused.get("EventOutcomeIndicator") == "4"


def test_the_schema_refuses_a_message_that_lacks_what_it_needs(tmp_path):
    (tmp_path / "bad.xml").write_text("<AuditMessage><EventIdentification/></AuditMessage>")
    judged = subprocess.run(
        ["xmllint", "--noout", "--relaxng", SCHEMA, tmp_path / "bad.xml"], capture_output=True, check=False
    )
    assert judged.returncode != 0


def test_hours_of_outage_cost_nothing_and_are_reported(desk, daemon, database):
    desk.turns()
    received(daemon, 7)
    desk.settle()
    daemon.stop(signal.SIGKILL)
    fill(database, 200)
    waits = desk.turns(5)
    assert waits[0] == 0.0
    assert waits[2:] == [1.0, 2.0, 4.0]
    assert "rows wait" in desk.forwarder.trouble
    desk.clock.advance_ns(3 * 3600 * NS_PER_S)
    assert "10800 s" in desk.forwarder.trouble
    daemon.start()
    desk.turns(10)
    found = received(daemon, 209)
    assert Counter(found) == Counter(range(1, 210))
    assert found == sorted(found)
    assert desk.forwarder.trouble is None
    assert [action for action in desk.actions() if action.startswith("audit.")] == [FAILED, RESUMED]


def test_an_outage_makes_the_waits_longer_up_to_a_minute(desk, daemon):
    daemon.stop(signal.SIGKILL)
    assert desk.turns(9) == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]


def test_a_server_that_restarts_at_once_is_no_outage(desk, daemon, database):
    desk.turns()
    received(daemon, 7)
    desk.settle()
    daemon.stop()
    daemon.start()
    fill(database, 1)
    desk.turns()
    assert received(daemon, 8) == list(range(1, 9))
    assert FAILED not in desk.actions()


def test_what_the_server_had_for_less_than_a_second_when_it_died_is_sent_again(desk, daemon, database):
    desk.turns()
    received(daemon, 7)
    desk.settle()
    fill(database, 2)
    desk.turns()
    received(daemon, 9)
    daemon.stop(signal.SIGKILL)
    daemon.start()
    fill(database, 1)
    desk.turns()
    assert received(daemon, 10) == [*range(1, 10), 8, 9, 10]


def test_a_restart_of_ours_in_order_sends_nothing_twice(desk, daemon, database):
    desk.forwarder.start()
    received(daemon, 7)
    fill(database, 1)
    desk.forwarder.stop(5.0)
    assert received(daemon, 8) == list(range(1, 9))
    assert desk.position == 8
    fill(database, 1)
    desk.made()
    desk.turns()
    assert received(daemon, 9) == list(range(1, 10))


def test_a_crash_of_ours_sends_again_only_what_was_not_settled(desk, daemon, database):
    desk.turns()
    desk.settle()
    assert desk.position == 7
    fill(database, 1)
    desk.turns()
    received(daemon, 8)
    assert desk.position == 7
    desk.made()
    desk.turns()
    fill(database, 1)
    desk.turns()
    assert received(daemon, 9) == [*range(1, 9), 8, 9]


def test_a_server_that_somebody_else_vouches_for_gets_nothing(database, daemon, tmp_path, our_pair):
    other = Authority(tmp_path, "other")
    desk = Desk(database, daemon, tmp_path, ca_file=other.file, pair=our_pair)
    assert desk.turns(1) == [0.5]
    assert "certificate" in desk.forwarder.trouble
    assert daemon.messages() == []


@pytest.mark.parametrize("whose", ["nobody's", "somebody else's"])
def test_without_a_certificate_that_the_server_knows_nothing_counts_as_passed_on(
    database, daemon, tmp_path, authority, whose
):
    pair = None if whose == "nobody's" else Authority(tmp_path, "other").pair("tidegate.test")
    desk = Desk(database, daemon, tmp_path, ca_file=authority.file, pair=pair)
    desk.turns(2)
    desk.settle()
    assert desk.forwarder.trouble is not None
    assert desk.position is None
    assert daemon.messages() == []


def test_a_server_of_another_name_gets_nothing(database, tmp_path, authority, our_pair):
    folder = tmp_path / "another"
    folder.mkdir()
    daemon = SyslogDaemon(folder, ca_file=authority.file, pair=authority.pair("elsewhere.test")).start()
    try:
        desk = Desk(database, daemon, tmp_path, ca_file=authority.file, pair=our_pair)
        desk.turns(1)
        assert "certificate" in desk.forwarder.trouble
        assert daemon.messages() == []
    finally:
        daemon.stop(signal.SIGKILL)


def test_after_a_restored_backup_it_goes_on_with_the_restore(desk, daemon, database, tmp_path):
    PositionFile(tmp_path / "forwarded.json").write(forwarding.Position(sequence=500, hash="gone"))
    desk.write(Event(actor="tidegate", action="backup.restored"))
    fill(database, 1)
    desk.turns()
    assert received(daemon, 9) == [8, 9]


def test_a_position_that_cannot_be_read_begins_with_this_start(desk, daemon, tmp_path):
    (tmp_path / "forwarded.json").write_text("nonsense")
    desk.turns()
    assert received(daemon, 7) == list(range(1, 8))


def test_a_service_with_a_syslog_host_passes_on_its_whole_life(database, daemon, tmp_path, authority, our_pair):
    settings = {
        "audit_syslog_host": "localhost",
        "audit_syslog_port": daemon.port,
        "audit_syslog_ca_file": authority.file,
        "audit_syslog_cert_file": our_pair.cert,
        "audit_syslog_key_file": our_pair.key,
    }
    supervised = SupervisedAudit(database, tmp_path, **settings).run()
    assert received(daemon, 9) == [8, 9]
    assert supervised.care.troubles == []
    supervised.run()
    assert received(daemon, 11) == [8, 9, 10, 11]
    assert b"service.stop" in daemon.messages()[-1]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"audit_syslog_host": "log.test"}, "audit_syslog_ca_file is not given"),
        ({"audit_syslog_cert_file": "cert.pem"}, "are one pair"),
        ({"audit_syslog_key_file": "key.pem"}, "are one pair"),
        ({"audit_syslog_timeout_s": 0.0}, "greater than or equal to 0.5"),
        ({"audit_anchor_interval_s": 0.5}, "greater than or equal to 1"),
        ({"audit_clock_jump_ms": 100_000.0}, "less than or equal to 60000"),
    ],
)
def test_settings_that_lead_nowhere_are_refused(given, said):
    with pytest.raises(ValidationError, match=said):
        Settings(**given)
