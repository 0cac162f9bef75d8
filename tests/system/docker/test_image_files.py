"""The image's recipe, read as text: no Docker engine is needed to see what must not be lost from it.

What it does when built and run is tried by hand (docs); here stand the promises an edit could break without noticing.
"""

import fnmatch
import re

import pytest

from service.core.settings.settings import PREFIX, Settings
from tests.support.repository import ROOT

DOCKERFILE = (ROOT / "docker/Dockerfile").read_text()
COMPOSE = (ROOT / "docker/compose.yaml").read_text()
INSTRUCTIONS = [
    line for line in re.sub(r"\\\n", " ", re.sub(r"(?m)^\s*#.*\n", "", DOCKERFILE)).splitlines() if line.strip()
]


def stages() -> list[list[str]]:
    """Split the instructions at each FROM."""
    found: list[list[str]] = []
    for line in INSTRUCTIONS:
        if line.startswith("FROM "):
            found.append([])
        if found:
            found[-1].append(line)
    return found


def final(instruction: str) -> list[str]:
    return [line for line in stages()[-1] if line.startswith(instruction)]


def served() -> list[str]:
    """Return the base name patterns that the builder is given."""
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    return [line.removeprefix("!") for line in lines if line.startswith("!")]


def test_the_image_is_built_in_stages_and_the_last_has_no_build_tools():
    assert len(stages()) == 2
    last = " ".join(stages()[-1])
    for tool in ("pip install", "gcc", "build-essential", "python3-venv", "-dev ", "git"):
        assert tool not in last, tool


def test_every_package_is_pinned_by_its_hash():
    installs = re.findall(r"pip install [^&]*", " ".join(INSTRUCTIONS))
    assert len(installs) == 3
    for install in installs:
        assert "--require-hashes" in install or "--no-index --no-deps /wheel" in install, install


def test_it_runs_as_an_unprivileged_user():
    user = final("USER")[-1].split()[1]
    uid, gid = (int(part) for part in user.split(":"))
    assert uid >= 1000
    assert gid >= 1000
    assert stages()[-1].index(final("USER")[-1]) < stages()[-1].index(final("ENTRYPOINT")[-1])


def test_it_is_asked_for_its_health_on_the_port_it_serves():
    port = re.search(r'"--port", "(\d+)"', final("CMD")[-1])
    assert port is not None
    assert final("EXPOSE") == [f"EXPOSE {port[1]}"]
    assert f"://127.0.0.1:{port[1]}/healthz" in final("HEALTHCHECK")[-1]
    assert f":{port[1]}" in COMPOSE


def test_data_lives_in_a_volume():
    assert final("VOLUME") == ['VOLUME ["/data"]']
    assert "TIDEGATE_DATA_DIR=/data" in " ".join(final("ENV"))


@pytest.mark.parametrize("text", [DOCKERFILE, COMPOSE], ids=["Dockerfile", "compose"])
def test_every_setting_named_is_one_that_exists(text: str):
    named = set(re.findall(rf"{PREFIX}([A-Z_]+)", text))
    assert named
    assert named <= {name.upper() for name in Settings.model_fields}


def test_everything_copied_is_there_and_given_to_the_builder():
    copies = [line.split()[1:-1] for line in stages()[0] if line.startswith("COPY ")]
    sources = [source for copy in copies for source in copy]
    assert sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert any(fnmatch.fnmatch(source, pattern) for pattern in served()), f"{source} is ignored"


def test_nothing_but_the_sources_is_given_to_the_builder():
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "*"
    assert not set(served()) & {".git", ".venv", "var", "data", "tests"}


def test_compose_publishes_to_this_machine_alone():
    assert re.search(r"(?m)^    ports:", COMPOSE) is None
    assert re.search(r"(?m)^    network_mode: host$", COMPOSE)
    assert re.search(r'(?m)^    command: \["serve", "--host", "127.0.0.1", "--port", "8000"\]$', COMPOSE)


def test_the_image_by_itself_does_not_serve_others_without_tls():
    assert '"--host", "0.0.0.0"' in final("CMD")[-1]
    assert "BEHIND_PROXY" not in " ".join(final("ENV"))
    assert "TLS_CERT" not in " ".join(final("ENV"))


@pytest.mark.parametrize(
    "line",
    [
        "read_only: true",
        "cap_drop:\n      - ALL",
        "no-new-privileges:true",
        "restart: unless-stopped",
        "tmpfs:",
        "data:/data",
    ],
)
def test_compose_gives_no_more_than_is_needed(line: str):
    assert line in COMPOSE


def test_no_camera_is_handed_in_unless_somebody_says_so():
    active = [line for line in COMPOSE.splitlines() if not line.strip().startswith("#")]
    assert "/dev/" not in "\n".join(active)
    assert "privileged: true" not in "\n".join(active)


@pytest.mark.parametrize("text", [DOCKERFILE, COMPOSE], ids=["Dockerfile", "compose"])
def test_no_address_but_our_own_is_written_down(text: str):
    assert re.findall(r"https?://(?!127\.0\.0\.1)", text) == []
