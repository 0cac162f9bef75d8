"""A camera driver whose cameras are made up; put in place of the real ones by ``use``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from engine.capture import drivers
from engine.capture.source import AS_IT_IS, CameraOptions, FactoryCalibration, ListedCamera, LiveSource, RegisteredView
from engine.core.clock import Clock
from engine.core.errors import RuntimeMissingError


class FakeDriver:
    """Lists what it is given.

    Attributes
    ----------
    opened
        Arguments of each camera that was asked for.
    """

    label, install_hint = "the fake SDK", "nothing helps"
    is_player = True
    warm_up_s = 900.0
    most_noise_mm = 12.0

    def __init__(
        self,
        cameras: Sequence[str] = (),
        *,
        prefix: str = "",
        make: Callable[[], Any] | None = None,
        view: Callable[[str], RegisteredView | None] = lambda _uri: None,
        is_here: bool = True,
    ) -> None:
        self.prefix, self.cameras, self.opened = prefix, list(cameras), list[dict[str, Any]]()
        self._make, self._view, self._is_here = make, view, is_here

    def is_installed(self) -> bool:
        return self._is_here

    def is_available(self) -> bool:
        return self._is_here

    def list_cameras(self) -> list[ListedCamera]:
        if not self._is_here:
            raise RuntimeMissingError("not here")
        return [ListedCamera(uri=uri, vendor="Virtual", name=uri) for uri in self.cameras]

    def camera(
        self,
        uri: str | None,
        *,
        clock: Clock,  # noqa: ARG002
        use_registration: bool = False,
        record_to: Path | None = None,
        options: CameraOptions = AS_IT_IS,  # noqa: ARG002
    ) -> LiveSource:
        self.opened.append({"uri": uri, "use_registration": use_registration, "record_to": record_to})
        assert self._make is not None, "this driver opens nothing"
        made: LiveSource = self._make()
        return made

    def player(self, path: Path, *, clock: Clock, record_to: Path | None = None) -> LiveSource | None:  # noqa: ARG002
        return None

    def factory_calibration(self, uri: str) -> FactoryCalibration | None:  # noqa: ARG002
        return None

    def registered_view(self, uri: str) -> RegisteredView | None:
        return self._view(uri)


def use(monkeypatch: pytest.MonkeyPatch, *fakes: FakeDriver) -> None:
    """Let these be the only drivers."""
    monkeypatch.setattr(drivers, "CAMERAS", fakes)
