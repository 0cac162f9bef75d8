"""README's session with curl, as it stands there: only its port is another, and its files lie elsewhere."""

import csv
import json
import os
import re
import subprocess

import pytest

from tests.support.repository import ROOT
from tests.support.service.processes import free_port

pytestmark = [pytest.mark.waiting, pytest.mark.verification]


def test_the_walk_of_the_readme_gates_a_session_and_ends(tmp_path):
    walk = re.search(r"## A first session with curl\n.*?```\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    port = free_port()
    path = f"{ROOT / '.venv' / 'bin'}:{os.environ['PATH']}"
    environment = {"PATH": path, "TIDEGATE_DATA_DIR": str(tmp_path / "data"), "TIDEGATE_PORT": str(port)}
    command = ["bash", "-c", f"set -m\n{walk.replace('127.0.0.1:8000', f'127.0.0.1:{port}')}\nwait"]
    ran = subprocess.run(
        command, cwd=tmp_path, env=os.environ | environment, check=False, capture_output=True, text=True, timeout=300
    )
    said = f"{ran.stdout}\n{ran.stderr}"
    assert '"gate":"beam_on"' in ran.stdout, said
    assert "problem:" not in ran.stdout, said
    assert json.loads(ran.stdout[ran.stdout.rindex("{") :])["is_intact"], said
    with (tmp_path / "samples.csv").open(newline="") as file:
        assert any(row["gate"] == "beam_on" for row in csv.DictReader(file))
