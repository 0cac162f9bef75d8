"""A session to a real PACS, Debian's Orthanc: what was read back is what was sent, over outages and restarts."""

import io
import socket
from itertools import pairwise
from unittest.mock import Mock

import pytest
from pydantic import ValidationError
from pydicom import Dataset, dcmread
from pynetdicom import AE, build_role

from engine.core.errors import InvalidValueError
from service.core.settings.settings import Settings
from service.exchange import pacs as pacs_module
from service.exchange.dicom import report_document, waveform
from service.exchange.outbox import Outbox
from service.exchange.pacs import PacsError, PacsSender, pacs_of, send
from tests.support.audit.syslog_certificates import Authority
from tests.support.exchange.orthanc import Orthanc
from tests.support.exchange.session_curve import PDF, curve, subject
from tests.support.service.processes import free_port
from tests.support.waiting import eventually

pytestmark = pytest.mark.waiting
FILES = [waveform(subject(), curve()), report_document(subject(), PDF)]
SESSION = "5e" * 16


class Log:
    """Events that were written."""

    def __init__(self):
        self.events = []

    def write(self, event):
        self.events.append(event)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    with Orthanc(tmp_path_factory.mktemp("orthanc")).running() as archive:
        yield archive


def sender(place, outbox, log, *, files_of=lambda _id: FILES, is_busy=lambda: False):
    return PacsSender(pacs_of(place), outbox, files_of, log, is_busy=is_busy)


def test_what_the_pacs_gives_back_is_what_was_sent(archive):
    send(pacs_of(archive.place), FILES)
    (study,) = archive.ask("studies?expand")
    assert study["PatientMainDicomTags"]["PatientID"] == "P-0001"
    assert len(study["Series"]) == 2
    found = {dcmread(io.BytesIO(one)).SOPClassUID.name: dcmread(io.BytesIO(one)) for one in archive.files()}
    assert found.keys() == {"Multi-channel Respiratory Waveform Storage", "Encapsulated PDF Storage"}
    for given in FILES:
        sent = dcmread(io.BytesIO(given))
        assert found[sent.SOPClassUID.name] == sent


def test_a_queue_outlives_an_outage_and_a_restart(tmp_path):
    archive, log = Orthanc(tmp_path / "orthanc"), Log()
    Outbox(tmp_path).ask(SESSION, "B. Physicist")
    sender(archive.place, Outbox(tmp_path), log).turn()  # nothing listens
    (waiting,) = Outbox(tmp_path).waiting()
    assert waiting.tries == 1
    assert "does not answer" in waiting.trouble
    with archive.running():
        again = sender(archive.place, Outbox(tmp_path), log)  # the service was started anew
        again.turn()
        assert Outbox(tmp_path).waiting() == []
        assert len(archive.files()) == 2
        again.turn()
    with archive.running():  # the PACS, too
        assert len(archive.files()) == 2
    assert [(one.action, one.outcome) for one in log.events] == [("session.sent", "failed"), ("session.sent", "done")]
    assert log.events[1].detail["asked_by"] == "B. Physicist"
    assert log.events[1].detail["tries"] == 2


def test_after_a_failure_it_waits_longer_each_time_and_the_audit_has_the_first(tmp_path, monkeypatch):
    log, outbox, now = Log(), Outbox(tmp_path), [100.0]
    monkeypatch.setattr(pacs_module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(pacs_module, "send", Mock(side_effect=PacsError("refused")))
    outbox.ask(SESSION, "B. Physicist")
    one = sender("ARCHIVE@localhost:104", outbox, log)
    pauses, tries = [], 0
    for _ in range(40_000):
        one.turn()
        if outbox.waiting()[0].tries > tries:
            tries = outbox.waiting()[0].tries
            pauses.append(now[0])
        if tries == 5:
            break
        now[0] += 1.0
    steps = [round(b - a) for a, b in pairwise(pauses)]
    assert steps == [10, 20, 40, 80]
    assert len(log.events) == 1


def test_while_a_session_runs_nothing_is_sent(tmp_path):
    outbox = Outbox(tmp_path)
    outbox.ask(SESSION, "B. Physicist")
    sender("ARCHIVE@localhost:104", outbox, Log(), is_busy=lambda: True).turn()
    assert outbox.waiting()[0].tries == 0


@pytest.mark.parametrize("kind", [PacsError, FileNotFoundError, ValueError])
def test_a_session_without_files_is_a_failure_that_holds_up_no_other(tmp_path, archive, kind):
    def files_of(session_id):
        if session_id == SESSION:
            raise kind("its samples were removed")
        return FILES

    outbox, log = Outbox(tmp_path), Log()
    outbox.ask(SESSION, "B. Physicist")
    outbox.ask("6f" * 16, "B. Physicist")
    one = sender(archive.place, outbox, log, files_of=files_of)
    one.turn()
    one.turn()
    assert [(each.session_id, each.trouble) for each in outbox.waiting()] == [(SESSION, "its samples were removed")]


def test_something_else_on_the_port_is_no_pacs():
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.MonkeyPatch.context() as patch:
        patch.setattr(pacs_module, "WAIT_S", 0.5)
        with pytest.raises(PacsError, match="does not answer"):
            send(pacs_of(f"ARCHIVE@127.0.0.1:{server.getsockname()[1]}"), FILES)


@pytest.mark.parametrize("is_kept", [True, False])
def test_the_pacs_confirms_what_it_keeps_and_gets_again_what_it_lost(tmp_path, is_kept):
    port = free_port()
    archive, log, outbox = Orthanc(tmp_path / "orthanc", commit_port=port), Log(), Outbox(tmp_path)
    outbox.ask(SESSION, "B. Physicist")
    with archive.running():
        one = PacsSender(
            pacs_of(archive.place, None, port), outbox, lambda _: FILES, log, is_busy=lambda: bool(log.events)
        )
        if not is_kept:  # what the report says of a file that the archive does not know
            sent = pacs_module._reference
            patched = pytest.MonkeyPatch()
            patched.setattr(pacs_module, "_reference", lambda file: _of_another(sent(file)))
        one.start()
        try:
            eventually(lambda: any(event.action == "session.committed" for event in log.events))
        finally:
            one.close()
            if not is_kept:
                patched.undo()
    (found,) = outbox.all()
    (told,) = (event for event in log.events if event.action == "session.committed")
    if is_kept:
        assert (found.state, told.outcome) == ("sent", "done")
        assert found.committed_at is not None
        assert found.transaction == told.detail["transaction"]
    else:
        assert (found.state, told.outcome, found.committed_at) == ("waiting", "failed", None)
        assert "does not keep 2 of the files" in found.trouble


def _of_another(reference):
    reference.ReferencedSOPInstanceUID += ".1"
    return reference


def test_a_report_of_another_transaction_and_of_another_archive_changes_nothing(tmp_path):
    outbox, log, port = Outbox(tmp_path), Log(), free_port()
    outbox.has_sent(outbox.ask(SESSION, "B. Physicist"))
    one = PacsSender(pacs_of("ARCHIVE@localhost:104", None, port), outbox, lambda _: FILES, log, is_busy=lambda: True)
    one.start()
    try:
        for title, status in (("ARCHIVE", 0x0115), ("STRANGER", None)):
            archive = AE(ae_title=title)
            archive.add_requested_context("1.2.840.10008.1.20.1")
            role = build_role("1.2.840.10008.1.20.1", scp_role=True)
            association = archive.associate("127.0.0.1", port, ae_title="TIDEGATE", ext_neg=[role])
            assert association.is_established is (status is not None)
            if status is not None:
                told = Dataset()
                told.TransactionUID = "2.25.1"
                answer, _ = association.send_n_event_report(told, 1, "1.2.840.10008.1.20.1", "1.2.840.10008.1.20.1.1")
                assert answer.Status == status
                association.release()
    finally:
        one.close()
    assert outbox.all()[0].committed_at is None
    assert log.events == []


def test_over_tls_only_the_authority_s_pacs_is_trusted(tmp_path):
    site, other = Authority(tmp_path, "site"), Authority(tmp_path, "other").file
    authority, pair = site.file, site.pair("localhost")
    archive = Orthanc(tmp_path / "orthanc", tls=(pair.cert, pair.key, authority))
    with archive.running():
        send(pacs_of(archive.place, authority), FILES)
        assert len(archive.files()) == 2
        for wrong in (other, None, tmp_path / "absent.pem"):
            with pytest.raises(PacsError):
                send(pacs_of(archive.place, wrong), FILES)


WRONG = ("", "ARCHIVE", "ARCHIVE@host", "@host:104", f"{'A' * 17}@host:104", "A@host:0", "A@host:65536")


@pytest.mark.parametrize("wrong", WRONG)
def test_a_place_of_another_form_is_refused(wrong):
    with pytest.raises(InvalidValueError, match="TITLE@host:port"):
        pacs_of(wrong)


def test_a_place_is_title_host_and_port():
    found = pacs_of("MY ARCHIVE@[::1]:11112")
    assert (found.title, found.host, found.port) == ("MY ARCHIVE", "::1", 11112)
    with pytest.raises(PacsError):
        send(pacs_of(f"ARCHIVE@127.0.0.1:{free_port()}"), FILES)


@pytest.mark.parametrize("wrong", [one for one in WRONG if one])
def test_the_site_s_setting_is_refused_by_name_where_it_is_read(wrong):
    with pytest.raises(ValidationError, match=r"pacs\n.*TITLE@host:port"):
        Settings(pacs=wrong)
    assert Settings(pacs="").pacs == ""
