"""The service on a fake engine, as the service's own tests have it."""

from tests.service.conftest import (  # noqa: F401 - fixtures
    calibration_id,
    calibration_text,
    client,
    engine,
    running,
    session_body,
    session_id,
    settings,
)
