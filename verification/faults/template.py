"""One session that learns, so that no other has to: its data folder is what every rig begins with."""

import fcntl
import json
import shutil
import time
from pathlib import Path

from verification.faults.operator import PATIENCE_S, PersonGaveUpError
from verification.faults.plan import Plan
from verification.faults.rig import Rig, Template

QUICK_TO_LEARN = Plan(
    name="learning",
    settings={
        "TRAINING_MIN_FRAMES": 150,
        "TRAINING_MIN_CYCLES": 3,
        "TRAINING_MIN_SECONDS": 8.0,
    },
)


def learned_once(folder: Path) -> Template:
    """Learn one for all test processes that share the folder: the first one learns, the others wait for it."""
    folder.mkdir(exist_ok=True)
    description = folder / "template.json"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not description.exists():
            shutil.rmtree(folder / "template", ignore_errors=True)
            template = learned(folder / "template")
            ids = {"calibration_id": template.calibration_id, "model_id": template.model_id}
            description.write_text(json.dumps(ids), encoding="utf-8")
    return Template(folder=folder / "template", **json.loads(description.read_text(encoding="utf-8")))


def learned(folder: Path) -> Template:
    """Learn a model of the virtual volunteer, end the session, and keep what lies in the data folder."""
    with Rig(folder.with_name(folder.name + "-rig"), QUICK_TO_LEARN, None) as rig:
        calibration_id = rig.person.upload(rig.camera.film.calibration.to_json().encode())
        rig.session_request = {"calibration_id": calibration_id}
        rig.new_session()
        end_s = time.monotonic() + PATIENCE_S
        while not (models := rig.person.models()):
            if time.monotonic() > end_s:
                raise PersonGaveUpError(f"nothing was learned: {rig.person.detail()}")
            time.sleep(0.2)
        rig.person.act("stop")
        rig.end_service()
        shutil.copytree(rig.data, folder)
    return Template(folder=folder, calibration_id=calibration_id, model_id=str(models[0]["id"]))
