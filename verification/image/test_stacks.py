"""The files of a room and of a department: valid, closed, in agreement; and the backup script does what it says."""

import os
import re
import shlex
import subprocess
import sys

import pytest
import yaml

from service.core.settings.names import CONFIG, OVERRIDES, PREFIX
from service.core.settings.settings import load_settings
from tests.support.repository import ROOT

ROOM, DEPARTMENT = ROOT / "docker/room", ROOT / "docker/department"
STACKS = {"try": ROOM / "try.yaml", "room": ROOM / "compose.yaml", "department": DEPARTMENT / "compose.yaml"}
VARIABLE = re.compile(r"\$\{([A-Z_]+)(:[?-][^}]*)?\}")
USER = "10001"


def stack(name):
    return yaml.safe_load(STACKS[name].read_text(encoding="utf-8"))


def services():
    return [(name, service) for name in ("room", "department") for service in stack(name)["services"].items()]


def schema_trouble(path):
    words = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode else ""


@pytest.mark.parametrize("name", STACKS)
def test_it_is_what_the_compose_specification_describes(name):
    assert schema_trouble(STACKS[name]) == ""


def test_the_specification_refuses_what_it_does_not_know(tmp_path):
    wrong = tmp_path / "compose.yaml"
    wrong.write_text(STACKS["room"].read_text(encoding="utf-8").replace("    read_only: true", "    read_onyl: true"))
    assert "read_onyl" in schema_trouble(wrong)


def test_a_room_is_tidegate_and_its_front_and_nothing_else():
    assert list(stack("room")["services"]) == ["tidegate", "front"]


@pytest.mark.parametrize(("name", "service"), services(), ids=lambda one: one if isinstance(one, str) else one[0])
def test_every_service_is_bounded_and_has_no_more_than_it_needs(name, service):
    _, made = service
    assert made["read_only"] is True
    assert made["cap_drop"] == ["ALL"]
    assert made["security_opt"] == ["no-new-privileges:true"]
    assert made["restart"] == "unless-stopped"
    assert re.fullmatch(r"\d+[mg]", made["mem_limit"])
    assert 0 < made["pids_limit"] <= 256
    assert set(made["logging"]["options"]) == {"max-size", "max-file"}
    assert "privileged" not in made
    assert not made["image"].endswith(":latest")


def test_tidegate_has_cores_files_and_memory_of_its_own_and_no_swap():
    made = stack("room")["services"]["tidegate"]
    assert made["cpuset"].startswith("${ROOM_CPUS:?")
    assert made["ulimits"]["nofile"] == 65536
    assert made["memswap_limit"] == made["mem_limit"]


@pytest.mark.parametrize("name", ["room", "department"])
def test_no_secret_stands_in_it_or_has_a_default(name):
    made = stack(name)
    for service in made["services"].values():
        for key, value in service.get("environment", {}).items():
            if re.search("PASSWORD|SECRET|TOKEN|_KEY", key):
                assert str(value).startswith("/run/secrets/"), key
        used = {one if isinstance(one, str) else one["source"] for one in service.get("secrets", ())}
        assert used <= set(made["secrets"])
    for secret in made["secrets"].values():
        assert set(secret) == {"file"}


@pytest.mark.parametrize(
    ("name", "example"),
    [("room", ROOM / "machine.env.example"), ("department", DEPARTMENT / "department.env.example")],
)
def test_every_variable_of_the_machine_is_in_the_example(name, example):
    named = {found[0] for found in VARIABLE.findall(STACKS[name].read_text(encoding="utf-8"))}
    given = {line.partition("=")[0] for line in example.read_text().splitlines() if re.match("[A-Z]", line)}
    assert given <= named
    optional = {"ROOM_FRONT_IMAGE"}
    assert named - optional == given


def test_the_settings_of_the_example_and_of_the_stack_start_a_service(monkeypatch, tmp_path):
    for key, value in stack("room")["services"]["tidegate"]["environment"].items():
        monkeypatch.setenv(key, str(value))
    monkeypatch.setenv(CONFIG, str(ROOM / "tidegate.toml.example"))
    settings = load_settings(host=None, port=None, data_dir=tmp_path, recordings_dirs=None)
    assert (settings.host, settings.behind_proxy, settings.port) == ("127.0.0.1", True, 8000)


@pytest.mark.parametrize("path", sorted([*ROOM.iterdir(), *DEPARTMENT.glob("*.*")]), ids=lambda path: path.name)
def test_every_setting_named_is_one_that_exists(path):
    named = set(re.findall(rf"{PREFIX}([A-Z_]+)(?==|:)", path.read_text(encoding="utf-8")))
    assert named <= {"CONFIG", *(name.upper() for name in OVERRIDES)}


@pytest.mark.parametrize("name", ["room", "department"])
def test_every_file_it_brings_in_is_there(name):
    for service in stack(name)["services"].values():
        for volume in service.get("volumes", ()):
            source = volume.partition(":")[0]
            if source.startswith("./"):
                assert (STACKS[name].parent / source).exists(), source


# -- compose and Quadlet


def unit(name):
    """Read a Quadlet file: keys of [Container] with all their values, and the words of PodmanArgs."""
    found: dict[str, list[str]] = {}
    section = ""
    for line in (ROOM / f"{name}.container").read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line
        elif section == "[Container]" and "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    found["args"] = [word for one in found.pop("PodmanArgs", []) for word in shlex.split(one)]
    return found


def of_unit(name):
    made = unit(name)
    options = dict(word.removeprefix("--").split("=", 1) for word in made["args"] if "ulimit" not in word)
    return {
        "name": made["ContainerName"][0],
        "network": made["Network"][0],
        "environment": dict(one.split("=", 1) for one in made.get("Environment", [])),
        "settings": made.get("EnvironmentFile", []),
        "mounts": {one.split(":")[1] for one in made["Volume"]},
        "tmpfs": set(made["Tmpfs"]),
        "read_only": made["ReadOnly"] == ["true"],
        "drops": [one.upper() for one in made["DropCapability"]],
        "adds": made.get("AddCapability", [""])[0].split(),
        "no_new_privileges": made["NoNewPrivileges"] == ["true"],
        "devices": options.get("device-cgroup-rule"),
        "memory": (options["memory"], options["memory-swap"]),
        "processes": int(options["pids-limit"]),
        "cpus": options.get("cpus"),
        "shares": options.get("cpu-shares"),
        "has_cores": "cpuset-cpus" in options,
        "stop_s": options.get("stop-timeout"),
        "limits": {word for word in made["args"] if "ulimit" in word},
        "health": [made.get(f"Health{key}", [None])[0] for key in ("Interval", "Timeout", "StartPeriod", "Retries")],
    }


def of_compose(name):
    made = stack("room")["services"][name]
    files = {one["target"] for one in made.get("secrets", ())}
    cpus = made.get("cpus")
    shares = made.get("cpu_shares")
    health = made.get("healthcheck", {})
    retries = health.get("retries")
    return {
        "name": made["container_name"],
        "network": made["network_mode"],
        "environment": made.get("environment", {}),
        "settings": [VARIABLE.sub(lambda one: one[2][2:], path) for path in made.get("env_file", ())],
        "mounts": {re.sub(r"\$\{[^}]*\}", "", one).split(":")[1] for one in made["volumes"]} | files,
        "tmpfs": set(made["tmpfs"]),
        "read_only": made["read_only"],
        "drops": made["cap_drop"],
        "adds": made.get("cap_add", []),
        "no_new_privileges": "no-new-privileges:true" in made["security_opt"],
        "devices": (made.get("device_cgroup_rules") or [None])[0],
        "memory": (made["mem_limit"], made["memswap_limit"]),
        "processes": made["pids_limit"],
        "cpus": None if cpus is None else str(cpus),
        "shares": None if shares is None else str(shares),
        "has_cores": "cpuset" in made,
        "stop_s": made["stop_grace_period"].removesuffix("s") if "stop_grace_period" in made else None,
        "limits": {f"--ulimit={key}={value}" for key, value in made["ulimits"].items()},
        "health": [health.get(key) for key in ("interval", "timeout", "start_period")]
        + [None if retries is None else str(retries)],
    }


@pytest.mark.parametrize("name", ["tidegate", "front"])
def test_compose_and_quadlet_agree(name):
    assert of_unit(name) == of_compose(name)


def test_the_front_of_both_is_the_same_program():
    image = stack("room")["services"]["front"]["image"]
    assert unit("front")["Image"] == [VARIABLE.sub(lambda one: one[2][2:], image)]


# -- the camera


def test_the_camera_is_opened_by_the_image_s_group_each_time_it_is_plugged_in_and_no_other_device_is():
    rules = [line for line in (ROOM / "71-tidegate-camera.rules").read_text().splitlines() if line[:1] not in {"#", ""}]
    user = re.search(r"(?m)^USER (\d+):(\d+)$", (ROOT / "docker/Dockerfile").read_text())
    assert rules
    assert user is not None
    for rule in rules:
        parts = rule.split(", ")
        assert all(re.fullmatch(r'[A-Z]+(\{\w+\})?(==|=)"[\w]+"', part) for part in parts), rule
        assert 'SUBSYSTEM=="usb"' in parts
        assert any(re.fullmatch(r'ATTR\{idVendor\}=="[0-9a-f]{4}"', part) for part in parts), "of one maker only"
        assert f'GROUP="{user[2]}"' in parts
        assert 'MODE="0660"' in parts
    room = stack("room")["services"]["tidegate"]
    assert "/dev/bus/usb:/dev/bus/usb" in room["volumes"]
    assert room["device_cgroup_rules"] == ["c 189:* rmw"]
    assert "devices" not in room, "a list of devices does not hold one that is plugged in again"


# -- backups


ENGINE = """#!/bin/sh
echo "$*" >> "$CALLS"
case "$1" in
  backup) echo backup > "$2" ;;
  restore) case " $* " in *" --check "*) exit "${CHECK_CODE:-0}" ;; *) exit "${DRILL_CODE:-0}" ;; esac ;;
esac
[ "$1" != backup ] || exit "${BACKUP_CODE:-0}"
"""


@pytest.fixture
def backed_up(tmp_path):
    engine, folder = tmp_path / "engine", tmp_path / "backups"
    engine.write_text(ENGINE)
    engine.chmod(0o755)
    folder.mkdir()
    for day in range(1, 5):
        (folder / f"2026-01-0{day}T023000Z.backup").write_text("old")
    (folder / "mine.backup").write_text("of a person")

    def run(*words, **environment):
        given = {"ROOM_RUN": engine, "DRILL_RUN": engine, "ROOM_BACKUP": folder, "ROOM_BACKUP_INSIDE": folder}
        given |= {"ROOM_BACKUPS_KEPT": "3", "CALLS": tmp_path / "calls", **environment}
        done = subprocess.run(
            [str(ROOM / "tidegate-backup"), *words],
            env={**os.environ, **{key: str(value) for key, value in given.items()}},
            capture_output=True,
            text=True,
            check=False,
        )
        calls = (tmp_path / "calls").read_text().splitlines() if (tmp_path / "calls").exists() else []
        return done.returncode, [line.split()[0] + line.partition(".backup")[2] for line in calls], folder

    return run


def test_a_backup_is_made_checked_and_only_then_the_oldest_go(backed_up):
    code, calls, folder = backed_up()
    assert (code, calls) == (0, ["backup", "restore --check"])
    left = sorted(path.name for path in folder.iterdir())
    assert [left[0], left[1], left[3]] == ["2026-01-03T023000Z.backup", "2026-01-04T023000Z.backup", "mine.backup"]
    assert len(left) == 4


def test_the_drill_restores_what_was_just_backed_up(backed_up):
    code, calls, _ = backed_up("--drill")
    assert (code, calls) == (0, ["backup", "restore --check", "restore"])


@pytest.mark.parametrize("failing", ["BACKUP_CODE", "CHECK_CODE", "DRILL_CODE"])
def test_nothing_is_removed_where_a_step_fails(backed_up, failing):
    code, _, folder = backed_up("--drill", **{failing: 1})
    assert code == 1
    assert (folder / "2026-01-01T023000Z.backup").exists()


@pytest.mark.parametrize(("words", "kept"), [(("--dril",), "3"), ((), "0"), ((), "x"), ((), "-1")])
def test_what_it_is_not_meant_for_is_refused(backed_up, words, kept):
    code, calls, folder = backed_up(*words, ROOM_BACKUPS_KEPT=kept)
    assert (code, calls) == (2, [])
    assert (folder / "2026-01-01T023000Z.backup").exists()


def test_a_real_data_folder_is_backed_up_and_its_drill_passes(tmp_path):
    (tmp_path / "backups").mkdir()
    command = f"{sys.executable} -m service.cli"
    subprocess.run(
        [*shlex.split(command), "database", "upgrade", "--data", str(tmp_path / "data")], cwd=ROOT, check=True
    )
    given = {
        "ROOM_RUN": f"env TIDEGATE_DATA_DIR={tmp_path / 'data'} {command}",
        "DRILL_RUN": f"env TIDEGATE_DATA_DIR={tmp_path / 'drill'} {command}",
        "ROOM_BACKUP": str(tmp_path / "backups"),
        "ROOM_BACKUP_INSIDE": str(tmp_path / "backups"),
    }
    words = [str(ROOM / "tidegate-backup"), "--drill"]
    done = subprocess.run(words, cwd=ROOT, env={**os.environ, **given}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "restore drill" in done.stdout
    assert (tmp_path / "drill" / "tidegate.db").exists()


@pytest.mark.parametrize("name", ["tidegate-backup", "tidegate-backup-drill"])
def test_the_timers_start_the_script(name):
    service = (ROOM / f"{name}.service").read_text()
    assert re.search(r"(?m)^ExecStart=/usr/local/sbin/tidegate-backup( --drill)?$", service)
    assert ("--drill" in service) == name.endswith("drill")
    assert re.search(r"(?m)^OnCalendar=\*-\*-(\*|01) \d\d:\d\d:\d\d$", (ROOM / f"{name}.timer").read_text())


# -- the department


def test_every_room_has_a_job_a_key_and_a_name_of_its_own():
    said = yaml.safe_load((DEPARTMENT / "prometheus/prometheus.yml").read_text(encoding="utf-8"))
    jobs = said["scrape_configs"]
    rooms = [target["labels"]["room"] for job in jobs for target in job["static_configs"]]
    keys = [job["authorization"]["credentials_file"] for job in jobs]
    assert len(jobs) == len(set(rooms)) == len(set(keys)) >= 2
    mounted = {f"/run/secrets/{name}" for name in stack("department")["services"]["prometheus"]["secrets"]}
    assert {*keys, *(job["tls_config"]["ca_file"] for job in jobs)} == mounted
    assert all(job["scheme"] == "https" for job in jobs)


def test_alerts_and_pictures_find_their_servers_by_the_names_of_the_stack():
    names = set(stack("department")["services"])
    said = yaml.safe_load((DEPARTMENT / "prometheus/prometheus.yml").read_text(encoding="utf-8"))
    (target,) = said["alerting"]["alertmanagers"][0]["static_configs"][0]["targets"]
    source = yaml.safe_load((DEPARTMENT / "grafana/provisioning/datasources/prometheus.yaml").read_text())
    addresses = [f"http://{target}", source["datasources"][0]["url"]]
    assert {re.match(r"http://([a-z]+):", one)[1] for one in addresses} <= names


def test_an_alert_goes_to_a_receiver_that_is_there():
    said = yaml.safe_load((DEPARTMENT / "alertmanager.yml").read_text(encoding="utf-8"))
    asked = {said["route"]["receiver"], *(one["receiver"] for one in said["route"]["routes"])}
    assert asked == {one["name"] for one in said["receivers"]}
    assert said["global"]["smtp_auth_password_file"] == "/run/secrets/smtp_password"
    assert "smtp_password" in stack("department")["services"]["alertmanager"]["secrets"]


def test_the_database_is_reached_over_tls_with_a_password_only():
    lines = [
        line.split() for line in (DEPARTMENT / "pg_hba.conf").read_text().splitlines() if line[:1] not in {"#", ""}
    ]
    assert lines
    for line in lines:
        assert line[0] in {"local", "hostssl"}
        assert line[-1] == "scram-sha-256"
