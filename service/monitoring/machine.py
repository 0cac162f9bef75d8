"""What runs here: versions, settings in force with their source, disk, certificate; for people who look after it."""

import json
import platform
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

from engine import __version__
from engine.offline.replay import METHOD
from service.core.schemas.base import Machine, MachineSetting, Readiness
from service.core.settings.names import place_of, setting_name
from service.core.settings.settings import Settings, sources
from service.engine_host.plug_ins import described, use_plug_ins
from service.monitoring.certificate import ServedCertificate
from service.storage.audit.check import redacted_settings

DEFAULT, COMMAND_LINE = "default", "command line"
MIB = 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MachineDescription:
    """Describes the machine; ``started_at`` is the service's start."""

    settings: Settings
    readiness: Callable[[], Readiness]
    backup_at: Callable[[], datetime | None]
    certificate: ServedCertificate | None = None
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))

    def describe(self) -> Machine:
        """Return the description; secrets in settings are replaced by a fixed text."""
        disk = shutil.disk_usage(self.settings.data_dir)
        return Machine(
            version=__version__,
            method=METHOD,
            python=platform.python_version(),
            system=f"{platform.system()} {platform.release()} {platform.machine()}",
            started_at=self.started_at,
            now=datetime.now(UTC),
            disk_free_mb=disk.free // MIB,
            disk_total_mb=disk.total // MIB,
            backup_at=self.backup_at(),
            certificate_ends_at=None if self.certificate is None else self.certificate.ends_at,
            plug_ins=list(map(described, use_plug_ins(self.settings))),
            readiness=self.readiness(),
            settings=self._settings(),
        )

    def _settings(self) -> list[MachineSetting]:
        came_from, fields = sources(), Settings.model_fields
        return [
            MachineSetting(
                name=setting_name(name),
                section=place_of(name)[0],
                value=json.dumps(value, ensure_ascii=False),
                source=COMMAND_LINE
                if came_from[name] == DEFAULT
                and getattr(self.settings, name) != fields[name].get_default(call_default_factory=True)
                else came_from[name],
            )
            for name, value in sorted(redacted_settings(self.settings).items(), key=lambda one: place_of(one[0]))
        ]
