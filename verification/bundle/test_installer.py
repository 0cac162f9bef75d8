"""The installer refuses what is not as signed, backs up before an upgrade, and goes back in the right order."""

import os
import pwd
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.small_bundle import make_bundle, make_key
from verification.bundle.maker import seal

PYTHON = Path(sys._base_executable)
# An account of its own, unless this machine's interpreter lies in a folder of root's.
ACCOUNT = "daemon" if all(folder.stat().st_mode & 0o001 for folder in PYTHON.resolve().parents) else "root"
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can install")


@pytest.fixture(scope="module")
def key(tmp_path_factory):
    return make_key(tmp_path_factory.mktemp("keys"))


@pytest.fixture
def bundle(tmp_path, key):
    return make_bundle(tmp_path, key)


def run(folder, *words):
    return subprocess.run(
        ["sh", str(folder / "install.sh"), *map(str, words)], capture_output=True, text=True, check=False
    )


def verify(folder, signers):
    return run(folder, "--allowed-signers", signers, "--verify-only")


def resign(folder, key):
    (folder / "SHA256SUMS.sig").unlink()
    words = ["ssh-keygen", "-q", "-Y", "sign", "-f", str(key.private), "-n", "another-use"]
    subprocess.run([*words, str(folder / "SHA256SUMS")], check=True)


def test_what_is_as_signed_is_accepted(bundle, key):
    done = verify(bundle, key.signers)
    assert (done.returncode, "signed by releases@tidegate: Tidegate 1.0.0" in done.stdout) == (0, True), done.stderr


def change(folder, _):
    with (folder / "tidegate.service").open("a") as file:
        file.write("# changed\n")


def change_wheel(folder, _):
    (wheel,) = (folder / "own").glob("*.whl")
    content = bytearray(wheel.read_bytes())
    content[len(content) // 2] ^= 1
    wheel.write_bytes(content)


def change_with_its_sum(folder, key):
    """As one who has no key would: the sums fit, the signature does not."""
    change(folder, key)
    sums = subprocess.run(["sha256sum", "tidegate.service"], cwd=folder, capture_output=True, text=True, check=True)
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    kept = [line for line in lines if not line.endswith("  tidegate.service")]
    (folder / "SHA256SUMS").write_text("\n".join([*kept, sums.stdout.strip()]) + "\n")


REFUSALS = {
    "a changed file": (change, "a file was changed"),
    "a changed wheel": (change_wheel, "a file was changed"),
    "a changed file with its sum": (change_with_its_sum, "the signature is not of the key"),
    "a missing file": (lambda folder, _: (folder / "LICENSE").unlink(), "exactly the files"),
    "an additional file": (lambda folder, _: (folder / "debs" / "more.deb").write_text(""), "exactly the files"),
    "a link": (lambda folder, _: (folder / "debs" / "link").symlink_to("/etc/passwd"), "links"),
    "no signature": (lambda folder, _: (folder / "SHA256SUMS.sig").unlink(), "the signature SHA256SUMS.sig is missing"),
    "no sums": (lambda folder, _: (folder / "SHA256SUMS").unlink(), "SHA256SUMS is missing"),
    "a signature for another use": (resign, "the signature is not of the key"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_not_as_signed_is_refused(bundle, key, name):
    spoil, said = REFUSALS[name]
    spoil(bundle, key)
    done = verify(bundle, key.signers)
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr


def test_another_key_is_refused(bundle, tmp_path):
    done = verify(bundle, make_key(tmp_path, "other").signers)
    assert (done.returncode, "the signature is not of the key" in done.stderr) == (2, True), done.stderr


def test_the_key_of_another_signer_is_refused(bundle, key, tmp_path):
    other = tmp_path / "signers"
    other.write_text(key.signers.read_text().replace("releases@tidegate", "other@tidegate"))
    assert verify(bundle, other).returncode == 2


def test_a_key_that_came_along_proves_nothing(bundle, key):
    shutil.copy(key.signers, bundle / "signers")
    done = verify(bundle, bundle / "signers")
    assert (done.returncode, "came with what it shall prove" in done.stderr) == (2, True), done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--allowed-signers FILE"),
        (("--allowed-signers",), "needs a value"),
        (("--allowed-signers", "/no/such/file"), "missing or empty"),
        (("--allowed-signer", "x"), "unknown option"),
    ],
)
@needs_root
def test_options_that_cannot_be_are_refused(bundle, words, said):
    done = run(bundle, *words)
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr


class Machine:
    """Folders to install to, instead of a machine's own."""

    def __init__(self, place):
        self.root, self.data, self.settings, self.backup = (
            place / name for name in ("root", "data", "settings", "backup")
        )
        self.backup.mkdir()
        shutil.chown(self.backup, ACCOUNT)

    def install(self, bundle, *words):
        return run(bundle, *self.options, *words)

    @property
    def options(self):
        places = ("--root", self.root, "--data", self.data, "--settings", self.settings, "--user", ACCOUNT)
        return (*places, "--python", PYTHON, "--no-debs", "--no-service")

    @property
    def current(self):
        return (self.root / "current").resolve().name

    def calls(self):
        """Return what the programs were asked: version, command, and its first argument where that is no path."""
        lines = (self.data / "calls").read_text().splitlines() if (self.data / "calls").exists() else []
        return [line.partition(" Room 1 ")[0].split()[0] + " " + line.partition(" Room 1 ")[2] for line in lines]


@pytest.fixture
def machine(tmp_path):
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and str(folder).startswith(("/tmp/", "/dev/shm/")):
            folder.chmod(folder.stat().st_mode | 0o011)
    return Machine(tmp_path)


@needs_root
def test_it_installs_upgrades_after_a_backup_and_goes_back_with_the_newer_program(machine, tmp_path, key):
    first, second = make_bundle(tmp_path, key), make_bundle(tmp_path, key, version="1.1.0", revision="0003")
    signed = ("--allowed-signers", key.signers)
    done = machine.install(first, *signed)
    assert done.returncode == 0, done.stderr
    assert (machine.current, machine.calls()) == ("1.0.0", [])
    assert (machine.root / "1.0.0/REVISION").read_text() == "0002\n"
    assert 'line = "simulated"' in (machine.settings / "tidegate.toml").read_text()

    done = machine.install(first, *signed)
    assert (done.returncode, "version 1.0.0 is installed already" in done.stderr) == (2, True)

    done = machine.install(second, *signed)
    assert (done.returncode, "a backup is made first" in done.stderr) == (2, True), done.stderr
    assert not (machine.root / "1.1.0").exists(), "what is refused changes nothing"
    (machine.data / "fail-backup").touch()
    done = machine.install(second, *signed, "--backup", machine.backup)
    assert (done.returncode, machine.current) == (1, "1.0.0"), "nothing is switched where the backup fails"
    (machine.data / "fail-backup").unlink()
    (machine.data / "calls").unlink()

    done = machine.install(second, *signed, "--backup", machine.backup)
    assert (done.returncode, machine.current) == (0, "1.1.0"), done.stderr
    assert [call.partition(f" {machine.backup}")[0] for call in machine.calls()] == ["1.0.0 backup"]

    (machine.data / "calls").unlink()
    for version in ("1.1.0", "0.9.0"):
        done = machine.install(second, "--rollback", version, "--backup", machine.backup)
        assert (done.returncode, machine.calls()) == (2, []), "to what runs, or is not there"
    assert machine.install(second, "--rollback", "1.0.0").returncode == 2, "without a backup"

    back = ("--rollback", "1.0.0", "--backup", machine.backup)
    (machine.data / "fail-database").touch()
    done = machine.install(second, *back)
    assert (done.returncode, machine.current) == (1, "1.1.0"), "the older program does not get newer tables"
    (machine.data / "fail-database").unlink()
    (machine.data / "calls").unlink()
    done = machine.install(second, *back)
    assert (done.returncode, machine.current) == (0, "1.0.0"), done.stderr
    first_call, second_call = machine.calls()
    assert first_call.startswith(f"1.1.0 backup {machine.backup}")
    assert second_call == "1.1.0 database downgrade 0002"
    account = str(pwd.getpwnam(ACCOUNT).pw_uid)
    assert {line.split()[1] for line in (machine.data / "calls").read_text().splitlines()} == {account}


@needs_root
def test_another_kind_of_processor_is_refused_before_anything_is_written(machine, tmp_path, key):
    folder = make_bundle(tmp_path, key)
    (folder / "MACHINE").write_text("vax\n")
    seal(folder, key.private)
    done = machine.install(folder, "--allowed-signers", key.signers)
    assert (done.returncode, "it is for vax" in done.stderr, machine.root.exists()) == (2, True, False), done.stderr
