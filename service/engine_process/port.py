"""Makes engines in processes of their own: what `tidegate serve` runs sessions with."""

from engine.calibration import Calibration
from engine.pipeline import PipelineSettings
from service import schemas
from service.engine_adapter import EngineAdapter
from service.engine_process.child import Child
from service.engine_process.messages import Prepare
from service.engine_process.remote import RemoteEngine, begin_session
from service.engine_process.standby import StandBy
from service.ports import RunningEngine, SessionPlan
from service.settings import Settings

CAMERA_IN_USE = "a session has the camera: this is what was there before it"


class ProcessEngine:
    """See the module; cameras are asked about themselves from this process, and never while a session has one."""

    def __init__(self, settings: Settings, *, measuring: PipelineSettings | None = None) -> None:
        self._adapter = EngineAdapter(settings)
        self._standby = StandBy(Prepare(settings=settings, measuring=measuring))
        self._has_camera = False
        self._listed: schemas.DeviceList | None = None
        self._lost = 0

    @property
    def is_simulated_beam(self) -> bool:
        """Whether any line is a simulation."""
        return self._adapter.is_simulated_beam

    @property
    def trouble(self) -> str | None:
        """Why no session could begin at once."""
        return self._standby.trouble

    @property
    def processes_lost(self) -> int:
        """How many ended by themselves, or had to be ended."""
        return self._lost + self._standby.lost

    def open(self, plan: SessionPlan) -> RunningEngine:
        """Start a session's engine, disarmed, in the process that stands by; raise what it raises."""
        child = self._standby.take()
        return self._adapter.begin(lambda: self._begun(plan, child))

    def _begun(self, plan: SessionPlan, child: Child) -> RemoteEngine:
        self._has_camera = isinstance(plan.source, schemas.DeviceSource)
        return begin_session(child, plan, on_gone=self._gone)

    def _gone(self, *, is_lost: bool) -> None:
        self._has_camera = False
        self._lost += is_lost
        self._standby.want()

    def registered_calibration(self, uri: str | None) -> Calibration:
        """Return the nominal calibration of a camera that registers depth to colour itself; refuse any other."""
        return self._adapter.registered_calibration(uri)

    def devices(self) -> schemas.DeviceList:
        """List the cameras that could be used; while a session has one, those of before."""
        if self._has_camera:
            listed = self._listed or schemas.DeviceList(is_runtime_available=True, detail="", items=[])
            return listed.model_copy(update={"detail": CAMERA_IN_USE})
        self._listed = self._adapter.devices()
        return self._listed

    def close(self) -> None:
        """End the process that stands by."""
        self._standby.close()
