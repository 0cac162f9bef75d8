"""The image's recipe, read as text, and its health check: what an edit could break without noticing.

`make docker-test` builds and runs the image.
"""

import fnmatch
import re

import pytest

from service.core.settings.names import PREFIX
from service.core.settings.settings import OVERRIDES  # filled as the settings are read
from tests.support.repository import ROOT

DOCKERFILE = (ROOT / "docker/Dockerfile").read_text()
COMPOSE = (ROOT / "docker/room/compose.yaml").read_text()
TRY = (ROOT / "docker/room/try.yaml").read_text()
QUADLET = (ROOT / "docker/room/tidegate.container").read_text()
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


def test_the_image_is_built_in_stages_and_the_last_begins_with_nothing_and_runs_nothing():
    assert [stage[0] for stage in stages()] == ["FROM ${BASE} AS build", "FROM ${BASE} AS system", "FROM scratch"]
    assert final("RUN") == []


def test_the_compiled_frame_path_is_tried_after_the_last_file_was_removed():
    steps = next(line for line in stages()[0] if "pip wheel" in line)
    assert steps.index("slim.py") < steps.index("TIDEGATE_FRAME_PATH=compiled")


def test_version_revision_and_time_are_labels():
    labels = " ".join(final("LABEL"))
    for name in ("version", "revision", "created"):
        assert f'org.opencontainers.image.{name}="${{{name.upper()}}}"' in labels
        assert f"ARG {name.upper()}" in stages()[-1]


def test_every_package_is_pinned_by_its_hash():
    installs = re.findall(r"pip install [^&]*", " ".join(INSTRUCTIONS))
    assert len(installs) == 5
    for install in installs:
        assert "--require-hashes" in install or "--no-index --no-deps /wheel" in install, install


def test_it_runs_as_an_unprivileged_user():
    user = final("USER")[-1].split()[1]
    uid, gid = (int(part) for part in user.split(":"))
    assert uid >= 1000
    assert gid >= 1000
    assert stages()[-1].index(final("USER")[-1]) < stages()[-1].index(final("ENTRYPOINT")[-1])


def test_it_is_asked_for_its_health_and_restarted_where_it_gives_no_answer():
    assert final("EXPOSE") == ["EXPOSE 8000"]
    assert "TIDEGATE_PORT=8000" in " ".join(final("ENV"))
    assert final("HEALTHCHECK")[-1].endswith('CMD ["tidegate-health"]')
    assert 'test: ["CMD", "tidegate-health", "--restart-after", "3"]' in COMPOSE
    assert "HealthOnFailure=kill" in QUADLET
    assert "Restart=always" in QUADLET


def test_data_lives_in_a_volume():
    assert final("VOLUME") == ['VOLUME ["/data"]']
    assert "TIDEGATE_DATA_DIR=/data" in " ".join(final("ENV"))


@pytest.mark.parametrize("text", [DOCKERFILE, COMPOSE, TRY, QUADLET], ids=["Dockerfile", "room", "try", "quadlet"])
def test_every_setting_named_is_one_that_exists(text: str):
    named = set(re.findall(rf"{PREFIX}([A-Z_]+)", text))
    assert named
    assert named <= {"CONFIG", *(name.upper() for name in OVERRIDES)}


def test_everything_copied_is_there_and_given_to_the_builder():
    copies = [line.split()[1:-1] for stage in stages() for line in stage if re.match("COPY (?!--from)", line)]
    sources = [source for copy in copies for source in copy]
    assert sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert any(fnmatch.fnmatch(source, f"{pattern}*") for pattern in served()), f"{source} is ignored"


def test_nothing_but_the_sources_is_given_to_the_builder():
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "*"
    assert not set(served()) & {".git", ".venv", "var", "data", "tests"}


@pytest.mark.parametrize("text", [COMPOSE, TRY], ids=["room", "try"])
def test_compose_publishes_to_this_machine_alone(text: str):
    assert re.search(r"(?m)^    ports:", text) is None
    assert re.search(r"(?m)^    network_mode: host$", text)
    assert re.search(r"(?m)^      TIDEGATE_HOST: 127.0.0.1$", text)


def test_the_image_by_itself_does_not_serve_others_without_tls():
    assert "TIDEGATE_HOST=0.0.0.0" in " ".join(final("ENV"))
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
    assert line in TRY


def test_no_camera_is_handed_in_on_a_desk_unless_it_is_asked_for():
    active = [line for line in TRY.splitlines() if not line.strip().startswith("#")]
    assert "/dev/" not in "\n".join(active)
    assert "privileged: true" not in "\n".join(active)


@pytest.mark.parametrize("text", [DOCKERFILE, COMPOSE, TRY, QUADLET], ids=["Dockerfile", "room", "try", "quadlet"])
def test_no_address_but_our_own_is_written_down(text: str):
    assert re.findall(r"https?://(?!127\.0\.0\.1)", text) == []


def test_nothing_of_a_cluster_comes_into_the_image():
    """A scheduler runs what anyone sends it; a room's image installs the run-time lock file, and SDKs if asked."""
    assert "else lock=requirements.lock; fi" in DOCKERFILE
    assert not re.search(
        r"requirements-(dev|cluster)\.lock[^\n]*-r|-r requirements-(cluster)\.lock|\[cluster\]", DOCKERFILE
    )
    room = {line.split("==")[0] for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line}
    assert not room & {"dask", "distributed", "cloudpickle", "tornado"}
    cluster = {
        line.split("==")[0] for line in (ROOT / "requirements-cluster.lock").read_text().splitlines() if "==" in line
    }
    assert room | {"dask", "distributed"} <= cluster
