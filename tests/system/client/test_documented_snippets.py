"""The snippets of the page for planning systems run as they stand, against a service."""

import re

from lab.simulated_tps.prescription import built_in_plan
from tests.support.planning.treatment_services import quick_room
from tests.support.repository import ROOT

SNIPPET = re.compile(r"<!-- runs: a fraction in a notebook -->\n```python\n(.*?)```", re.DOTALL)


def test_the_snippets_of_the_page_for_planning_systems_run_as_they_stand(tmp_path, capsys):
    plan = tmp_path / "plan.dcm"
    plan.write_bytes(built_in_plan())
    snippets = SNIPPET.findall((ROOT / "docs" / "4-integrate" / "integration.md").read_text())
    assert len(snippets) == 3
    with quick_room(tmp_path) as room:
        given = {
            "URL": room.url,
            "KEY": room.key,
            "PLAN": plan,
            "CALIBRATION": tmp_path / "calibration.json",
            "RECORDING": "chest.oni",
            "FOLDER": tmp_path,
            "BEAM_SECONDS": 0.5,
        }
        try:
            for snippet in snippets:
                exec(compile(snippet, "docs/4-integrate/integration.md", "exec"), given)
        finally:
            if "tidegate" in given:
                given["tidegate"].close()
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("not ready: ")
    assert printed[-1] == "True True True"
