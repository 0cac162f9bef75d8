"""`--scheduler`: an address and three files, or nothing; without TLS only on this machine."""

import pytest
from typer.testing import CliRunner

from engine.core.errors import InvalidValueError
from service.cli import app
from service.cli.cluster.options import scheduler_options


@pytest.fixture
def files(tmp_path):
    found = [tmp_path / name for name in ("ca.pem", "cert.pem", "key.pem")]
    for file in found:
        file.write_text("")
    return found


def test_without_an_address_there_is_no_cluster_and_no_tls_option():
    assert scheduler_options(None, None, None, None) is None


def test_an_address_with_tls_has_its_three_files(files):
    found = scheduler_options("tls://head.example:8786", *files)
    assert (found.address, found.authority, found.certificate, found.key) == ("tls://head.example:8786", *files)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "tcp://[::1]:8786", "tcp://localhost:8786"])
def test_without_tls_the_scheduler_is_on_this_machine(address):
    assert scheduler_options(address, None, None, None).key is None


@pytest.mark.parametrize("address", ["tcp://10.0.0.1:8786", "tcp://head.example:8786", "tcp://127.example:8786"])
def test_a_scheduler_of_another_machine_needs_tls(address):
    with pytest.raises(InvalidValueError, match="a scheduler runs what anyone sends it"):
        scheduler_options(address, None, None, None)


@pytest.mark.parametrize(
    "address",
    [
        "",
        "head:8786",
        "tls://head",
        "tls://:8786",
        "https://head:8786",
        "tls://head:99999",
        "tls://head:1/x",
        "tls://u@h:1",
    ],
)
def test_an_address_of_another_form_is_refused_by_name(files, address):
    with pytest.raises(InvalidValueError, match=r"scheduler .*tls://HOST:PORT"):
        scheduler_options(address, *files)


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_each_of_the_three_files_is_needed_and_has_to_exist(files, missing):
    name = ("tls-ca", "tls-cert", "tls-key")[missing]
    given = [None if number == missing else file for number, file in enumerate(files)]
    with pytest.raises(InvalidValueError, match=name):
        scheduler_options("tls://head:8786", *given)
    files[missing].unlink()
    with pytest.raises(InvalidValueError, match=name):
        scheduler_options("tls://head:8786", *files)


def test_tls_files_without_a_tls_scheduler_are_refused(files):
    with pytest.raises(InvalidValueError, match=r"tls-ca .*left out without --scheduler"):
        scheduler_options(None, *files)
    with pytest.raises(InvalidValueError, match=r"tls-ca .*left out for tcp"):
        scheduler_options("tcp://127.0.0.1:8786", *files)


@pytest.mark.parametrize("command", [["measure", "a.oni"], ["evaluate"]], ids=lambda command: command[0])
def test_jobs_of_this_machine_and_a_scheduler_exclude_each_other(command, tmp_path):
    options = ["--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"]
    result = CliRunner().invoke(app, [*command, *options])
    assert result.exit_code == 2
    assert "jobs is 2: must be left out with --scheduler" in result.output
    assert not (tmp_path / "out").exists()
