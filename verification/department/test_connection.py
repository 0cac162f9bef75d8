"""How the hub reaches a room: by TLS, the room's name checked, Tidegate's database only."""

import os
import pwd
import shutil

import psycopg
import pytest

from tests.support.access.tls_certificate import make_certificate
from tests.support.audit.rows import fill
from tests.support.department.replication import (
    FILES,
    PASSWORD,
    ROLE,
    ScriptError,
    complete,
    execute,
    publish,
    subscribe,
)


def given(path):
    """Give a file to PostgreSQL's account."""
    path.chmod(0o600)
    if os.getuid() == 0:
        shutil.chown(path, *pwd.getpwnam("postgres")[2:4])
    return path


@pytest.fixture
def guarded(followed, tmp_path):
    """A room with a certificate and the lines of room_hba.conf, and the authority's certificate for the hub."""
    server = followed.room
    publish(server, followed.name)
    for made in make_certificate(tmp_path):
        given(shutil.copy(made, server.folder / made.name))
    rules = server.folder / "data" / "pg_hba.conf"
    before = rules.read_text()
    lines = (FILES / "room_hba.conf").read_text().replace("192.0.2.10/32", "127.0.0.1/32")
    rules.write_text(lines.replace("   tidegate      tidegate_", f"   {followed.name}   tidegate_") + before)
    files = [f"ALTER SYSTEM SET ssl_{kind}_file = '{server.folder}/{kind}.pem'" for kind in ("cert", "key")]
    execute(server, "postgres", *files, "ALTER SYSTEM SET ssl = on", "SELECT pg_reload_conf()")
    yield given(shutil.copy(tmp_path / "cert.pem", followed.hub.folder / "site-ca.pem"))
    rules.write_text(before)
    execute(server, "postgres", "ALTER SYSTEM RESET ALL", "SELECT pg_reload_conf()")


def follow(room, tls):
    subscribe(room.hub, room.hub_name, room.room, room.name, tls=tls)


def test_a_room_is_followed_over_tls_with_its_name_checked(followed, guarded):
    fill(followed.database, 3)
    follow(followed, f"sslmode=verify-full sslrootcert={guarded}")
    complete(followed.hub, followed.hub_name)
    assert followed.arrive().startswith("audit|3|")


def test_another_room_s_certificate_is_refused(followed, guarded, tmp_path):
    (tmp_path / "other").mkdir()
    other, _ = make_certificate(tmp_path / "other")
    strange = given(shutil.copy(other, followed.hub.folder / "strange.pem"))
    with pytest.raises(ScriptError, match="certificate verify failed"):
        follow(followed, f"sslmode=verify-full sslrootcert={strange}")


def test_without_tls_nothing_is_answered(followed, guarded):
    with pytest.raises(ScriptError, match=r"pg_hba\.conf rejects"):
        follow(followed, "sslmode=disable")


@pytest.mark.parametrize("way", [{"dbname": "postgres"}, {"dbname": "x", "replication": "true"}])
def test_the_role_reaches_no_other_database_and_copies_no_server(followed, guarded, way):
    words = {"host": "127.0.0.1", "port": followed.room.port, "user": ROLE, "password": PASSWORD, "sslmode": "require"}
    with pytest.raises(psycopg.OperationalError, match=r"pg_hba\.conf rejects"):
        psycopg.connect(**words, **way)
