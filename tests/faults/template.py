"""One session that learns, so that no other has to: its data folder is what every rig begins with."""

import atexit
import functools
import shutil
import tempfile
import time
from pathlib import Path

from tests.faults.person import PATIENCE_S, PersonGaveUpError
from tests.faults.plan import Plan
from tests.faults.rig import Rig, Template

QUICK_TO_LEARN = Plan(
    name="learning",
    settings={
        "TRAINING_MIN_FRAMES": 150,
        "TRAINING_MAX_FRAMES": 400,
        "TRAINING_MIN_CYCLES": 3,
        "TRAINING_MIN_SECONDS": 8.0,
    },
)


@functools.cache
def learned_here() -> Template:
    """Learn one for all tests of this process."""
    folder = Path(tempfile.mkdtemp(prefix="tidegate-learned-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return learned(folder / "template")


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
