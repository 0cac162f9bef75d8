"""What the gate counts for the camera: the larger of the site's value and the session's camera's."""

import pytest

from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host import local_engine
from service.engine_host.local_engine import LocalEngine
from service.engine_host.site_limits.window_limits import gate_limits
from tests.support.engine_process.bench import make_plan
from tests.support.service.api_calls import WINDOW


@pytest.mark.parametrize(
    ("site_ms", "camera_ms", "counted_ms"),
    [(20.0, None, 20.0), (20.0, 50.0, 50.0), (20.0, 10.0, 20.0), (0.0, 0.0, 0.0)],
)
def test_the_limits_have_the_larger_one(site_ms, camera_ms, counted_ms):
    settings = Settings(camera_latency_ms=site_ms)
    limits = gate_limits(Window.model_validate(WINDOW), settings, camera_latency_ms=camera_ms)
    assert limits.camera_latency_ms == counted_ms


def test_the_engine_takes_it_from_the_plan(tmp_path, monkeypatch):
    asked = []

    def stop_here(*_given, **named):
        asked.append(named["camera_latency_ms"])
        raise InterruptedError

    monkeypatch.setattr(local_engine, "gate_limits", stop_here)
    with pytest.raises(InterruptedError):
        LocalEngine(Settings(data_dir=tmp_path)).open(make_plan(camera_latency_ms=77.0))
    assert asked == [77.0]
