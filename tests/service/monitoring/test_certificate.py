"""The certificate that is served: replaced without a restart, never by one that cannot be used; refused in one line."""

import asyncio
import logging
import shutil
import socket
import ssl
import threading
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509

from service.monitoring.certificate import CertificateError, ServedCertificate
from tests.support.access.tls_certificate import make_certificate
from tests.support.waiting import PATIENCE_S

LONG = timedelta(days=300)


@pytest.fixture
def files(tmp_path):
    return make_certificate(tmp_path, ends_in=LONG)


def made_elsewhere(tmp_path, **options):
    folder = tmp_path / "elsewhere"
    folder.mkdir(exist_ok=True)
    return make_certificate(folder, **options)


def break_in_a_way(way, files, tmp_path):
    cert, key = files
    if way == "missing":
        cert.unlink()
    elif way == "cut off":
        cert.write_bytes(cert.read_bytes()[:200])
    elif way == "other key":
        shutil.copy(made_elsewhere(tmp_path)[1], key)
    elif way == "other certificate":
        shutil.copy(made_elsewhere(tmp_path)[0], cert)
    else:
        options = {
            "ended": {"ends_in": -timedelta(minutes=1)},
            "not yet valid": {"began_before": -timedelta(hours=1)},
            "passphrase": {"passphrase": "secret"},
        }
        make_certificate(tmp_path, **options[way])


WAYS = {
    "missing": "No such file",
    "cut off": "cert.pem",
    "other key": "the key does not belong to the certificate",
    "other certificate": "the key does not belong to the certificate",
    "ended": "the certificate ended on",
    "not yet valid": "the certificate is valid from",
    "passphrase": "the key has a passphrase",
}


class Door:
    """A TLS server of asyncio's with the certificate's context: shows what a client is shown."""

    def __init__(self, certificate):
        self.certificate = certificate
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever)

    async def _serve(self):
        async def echo(reader, writer):
            while line := await reader.readline():
                writer.write(line)
            writer.close()

        return await asyncio.start_server(echo, "127.0.0.1", 0, ssl=self.certificate.context)

    def __enter__(self):
        self.thread.start()
        self.server = asyncio.run_coroutine_threadsafe(self._serve(), self.loop).result(PATIENCE_S)
        self.port = self.server.sockets[0].getsockname()[1]
        return self

    def __exit__(self, *_):
        async def stop():
            self.server.close()
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(stop(), self.loop).result(PATIENCE_S)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(PATIENCE_S)
        self.loop.close()

    def connect(self, *, name=None, newest=ssl.TLSVersion.TLSv1_3):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.maximum_version = newest
        raw = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        return context.wrap_socket(raw, server_hostname=name)


def shown_on(connection):
    return x509.load_der_x509_certificate(connection.getpeercert(binary_form=True)).serial_number


def serial_of(cert):
    return x509.load_pem_x509_certificate(cert.read_bytes()).serial_number


def says_hello(connection):
    connection.sendall(b"hello\n")
    return connection.recv(100) == b"hello\n"


@pytest.mark.parametrize("name", [None, "gating.example"], ids=["by address", "by name"])
@pytest.mark.parametrize("newest", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3], ids=lambda one: one.name)
def test_new_connections_get_the_new_certificate_and_present_ones_go_on(files, tmp_path, name, newest):
    certificate = ServedCertificate(*files)
    first = serial_of(files[0])
    with Door(certificate) as door, door.connect(name=name, newest=newest) as old:
        assert shown_on(old) == first
        make_certificate(tmp_path, ends_in=2 * LONG)
        certificate.look()
        with door.connect(name=name, newest=newest) as new:
            assert shown_on(new) == serial_of(files[0]) != first
            assert says_hello(new)
        assert says_hello(old)
    assert certificate.ends_at > datetime.now(UTC) + LONG + timedelta(days=1)


@pytest.mark.parametrize("way", WAYS)
def test_new_files_that_cannot_be_used_are_refused_and_the_one_before_is_served(files, tmp_path, way, caplog):
    certificate = ServedCertificate(*files)
    first, ends_at = serial_of(files[0]), certificate.ends_at
    break_in_a_way(way, files, tmp_path)
    with Door(certificate) as door, caplog.at_level(logging.WARNING):
        for _ in range(3):
            certificate.look()
        assert WAYS[way] in certificate.refusal
        assert len(caplog.records) == 1, "logged once, however often it is looked at"
        assert certificate.ends_at == ends_at
        with door.connect() as connection:
            assert shown_on(connection) == first
            assert says_hello(connection)
        make_certificate(tmp_path, ends_in=LONG)
        certificate.look()
        assert certificate.refusal is None
        with door.connect() as connection:
            assert shown_on(connection) == serial_of(files[0]) != first


@pytest.mark.parametrize("way", WAYS)
def test_a_start_with_a_certificate_that_cannot_be_used_is_refused(files, tmp_path, way):
    break_in_a_way(way, files, tmp_path)
    with pytest.raises(CertificateError, match=WAYS[way]) as refused:
        ServedCertificate(*files)
    assert "cannot be used for TLS" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_files_that_change_while_they_are_read_are_not_taken(files, monkeypatch):
    certificate = ServedCertificate(*files)
    reads = iter([(b"new", b"new"), *[certificate._served.content], (b"newer", b"newer")])
    monkeypatch.setattr(certificate, "_read", lambda: next(reads))
    certificate.look()
    assert "being replaced" in certificate.refusal


def test_the_first_files_again_clear_a_refusal(files):
    certificate = ServedCertificate(*files)
    good = files[0].read_bytes()
    files[0].write_text("nothing")
    certificate.look()
    assert certificate.refusal is not None
    files[0].write_bytes(good)
    certificate.look()
    assert certificate.refusal is None


def test_an_expiry_is_logged_once_when_it_is_near_and_once_when_it_is_past(files, caplog):
    late = timedelta()
    certificate = ServedCertificate(*files, now=lambda: datetime.now(UTC) + late)
    lines = []
    for late in (timedelta(), LONG - timedelta(days=29), LONG - timedelta(days=1), LONG + timedelta(days=1), 2 * LONG):  # noqa: B007
        with caplog.at_level(logging.WARNING):
            certificate.look()
        lines.append(len(caplog.records))
    assert lines == [0, 1, 1, 2, 2]
    assert "ends on" in caplog.messages[0]
    assert "ended on" in caplog.messages[1]


def test_the_earliest_expiry_of_a_chain_counts(files, tmp_path):
    other, _ = made_elsewhere(tmp_path, ends_in=timedelta(days=3))
    files[0].write_bytes(files[0].read_bytes() + other.read_bytes())
    certificate = ServedCertificate(*files)
    assert certificate.ends_at < datetime.now(UTC) + timedelta(days=4)


def test_its_thread_looks_by_itself_and_ends_when_it_is_closed(files, tmp_path, monkeypatch):
    monkeypatch.setattr("service.monitoring.certificate.LOOK_S", 0.01)
    certificate = ServedCertificate(*files)
    certificate.start()
    make_certificate(tmp_path, ends_in=2 * LONG)
    from tests.support.waiting import eventually

    eventually(lambda: certificate.ends_at > datetime.now(UTC) + LONG + timedelta(days=1))
    certificate.close()
    assert not certificate.has_ended
