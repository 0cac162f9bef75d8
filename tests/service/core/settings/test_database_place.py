"""Where the database is: the settings that say so, and the password that no one gets to see."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from pydantic import ValidationError
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from service.core.settings.database_place import shown_place
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from tests.support.database.postgres import PASSWORD

pytestmark = pytest.mark.slow

URL = "postgresql://tidegate:s3cret-word@127.0.0.1/tidegate"


def test_without_a_url_it_is_the_file_in_the_data_folder(tmp_path):
    assert Settings(data_dir=tmp_path).database_place == tmp_path / "tidegate.db"


@pytest.mark.parametrize("scheme", ["postgresql", "postgres", "postgresql+psycopg"])
def test_a_url_names_a_server_whatever_its_scheme_is_called(scheme):
    place = Settings(database_url=URL.replace("postgresql", scheme)).database_place
    assert (place.drivername, place.password) == ("postgresql+psycopg", "s3cret-word")


def test_the_password_is_in_nothing_that_is_shown():
    settings = Settings(database_url=URL)
    shown = [repr(settings), str(settings.model_dump(mode="json")), shown_place(settings.database_place)]
    with closing(Database(settings.database_place)) as database:
        shown += [repr(database), str(database.place)]
    assert not [one for one in shown if "s3cret" in one]


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("mysql://s3cret-word@127.0.0.1/x", "must begin with postgresql:// or postgres://, not with mysql://"),
        ("sqlite:///s3cret-word.db", "not with sqlite://"),
        ("s3cret-word", "must begin with postgresql://"),
        ("postgresql://tidegate:s3cret-word@127.0.0.1", "must name a database"),
        ("postgresql://tidegate:s3cret-word@db.example/tidegate", "must say how that is secured"),
        ("postgresql://tidegate:s3cret-word@/tidegate?host=/run,db.example", "must say how that is secured"),
        ("postgresql://tidegate:s3cret-word@127.0.0.1/tidegate?hostaddr=10.0.0.1", "must say how that is secured"),
        ("", "should have at least 1"),
    ],
)
def test_a_url_that_cannot_be_meant_is_refused_without_showing_it(url, words):
    with pytest.raises(ValidationError) as caught:
        Settings(database_url=url)
    messages = " ".join(str(error["msg"]) for error in caught.value.errors())
    assert words in messages
    assert "s3cret" not in messages


@pytest.mark.parametrize("query", ["sslmode=verify-full&sslrootcert=/etc/ca.pem", "sslmode=disable"])
def test_another_machine_is_taken_once_it_is_stated_how_the_way_is_secured(query):
    assert Settings(database_url=f"postgresql://tidegate@db.example/tidegate?{query}").database_place


def test_the_password_may_lie_in_a_file(tmp_path):
    secret = tmp_path / "password"
    secret.write_text("from the file\n")
    place = Settings(database_url="postgresql://me@127.0.0.1/x", database_password_file=secret).database_place
    assert place.password == "from the file"


@pytest.mark.parametrize(
    ("url", "content", "words"),
    [
        (URL, "one", "give one of them"),
        ("postgresql://me@127.0.0.1/x", None, "cannot be read"),
        ("postgresql://me@127.0.0.1/x", "", "must hold one line"),
        ("postgresql://me@127.0.0.1/x", "two\nlines", "must hold one line"),
        (None, "one", "belongs to database_url"),
    ],
)
def test_a_password_file_that_cannot_be_meant_is_refused(tmp_path, url, content, words):
    secret = tmp_path / "password"
    if content is not None:
        secret.write_text(content)
    with pytest.raises(ValidationError, match=words):
        Settings(database_url=url, database_password_file=secret)


def test_a_server_is_reached_with_the_password_and_not_without(postgres_server, tmp_path):
    name = postgres_server.migrated().database
    secret = tmp_path / "password"
    secret.write_text(PASSWORD)
    bare = postgres_server.tcp_url(name, password=None).render_as_string(hide_password=False)
    with closing(Database(Settings(database_url=bare, database_password_file=secret).database_place)) as database:
        with database.read() as db:
            assert db.scalar(text("SELECT current_user")) == "tidegate"
        assert database.trouble() is None
    with closing(Database(postgres_server.tcp_url(name, password="s3cret-word"))) as database:
        with pytest.raises(SQLAlchemyError) as refused, database.read() as db:
            db.scalar(text("SELECT 1"))
        assert "s3cret" not in str(refused.value)


def test_a_new_file_is_its_owner_s_alone_with_those_beside_it(tmp_path):
    with closing(Database(tmp_path / "new.db")) as database:
        with database.write() as db:
            db.execute(text("CREATE TABLE x (y INTEGER)"))
        modes = {path.name: path.stat().st_mode & 0o777 for path in Path(tmp_path).glob("new.db*")}
    assert len(modes) == 3
    assert set(modes.values()) == {0o600}


def test_a_database_in_use_stays_whole_when_it_is_opened_again_here_and_another_program_comes_and_goes(tmp_path):
    """To close a file drops all locks a process has on it; a program that came last would then remove the log."""
    path = tmp_path / "used.db"
    come_and_go = (
        f"import sqlite3; c = sqlite3.connect({str(path)!r}); c.execute('SELECT count(*) FROM x').fetchall(); c.close()"
    )
    with closing(Database(path)) as database, database.connect() as held:
        held.execute(text("CREATE TABLE x (y INTEGER)"))
        held.commit()
        held.execute(text("SELECT * FROM x")).all()
        with closing(Database(path)) as again, again.read() as db:
            db.execute(text("SELECT 1"))
        subprocess.run([sys.executable, "-c", come_and_go], check=True)
        assert path.with_name("used.db-wal").exists()
        held.rollback()
        held.execute(text("INSERT INTO x VALUES (1)"))
        held.commit()
    with closing(Database(path)) as database, database.read() as db:
        assert db.scalar(text("SELECT count(*) FROM x")) == 1
