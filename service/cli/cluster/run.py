"""The client's side of a run on a Dask cluster: submit the jobs, accept one result each, put its files in place.

Nothing but the client writes where results belong, so a killed, lost or cancelled worker leaves nothing half-written.
"""

import contextlib
import logging
import pickle
import queue
import shutil
import signal
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from engine.core.errors import TidegateError
from service.cli.cluster.options import SchedulerOptions
from service.cli.cluster.worker import (
    MARKER,
    ClusterJob,
    JobDone,
    WorkerRefusedError,
    examine,
    identity,
    run_job,
    stop_run,
)
from service.cli.terminal import say

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_TIMEOUT_S = 10.0
MAX_REFUSALS = 3
STAGING = ".cluster-"
NOISY_LOGGERS = ("distributed", "distributed.client", "tornado.application", "asyncio")
"""Loggers that print tracebacks of a lost connection; Dask gives each a level of its own."""
OTHER_VERSION = (WorkerRefusedError, ImportError, AttributeError)
"""How a job ends in a worker whose Tidegate is another one, or has no such module."""
OnReport = Callable[[int, dict[str, Any]], None]


class ClusterError(TidegateError):
    """The cluster cannot be reached, or its workers cannot take part."""

    code = "cluster"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """The end of a job: its value and its files below ``folder``, or the reason why there is none."""

    value: object = None
    folder: Path | None = None
    files: tuple[str, ...] = ()
    failure: str | None = None


OnFinished = Callable[[int, Finished], None]


@contextmanager
def connected(options: SchedulerOptions) -> Iterator["Client"]:
    """Connect to the scheduler.

    Raises
    ------
    ClusterError
        The extra is not installed, or the scheduler does not answer, or refuses the certificate.
    """
    try:
        from distributed import Client, Security
    except ImportError as error:
        raise ClusterError("--scheduler needs Dask: install tidegate[cluster]") from error
    for name in NOISY_LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # each refusal is one line of ours
    files = {"tls_ca_file": options.authority, "tls_client_cert": options.certificate, "tls_client_key": options.key}
    security = (
        Security(require_encryption=True, **{name: str(file) for name, file in files.items()})
        if options.key is not None
        else Security(require_encryption=False)
    )
    try:
        client = Client(options.address, security=security, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except OSError as error:
        msg = f"the scheduler {options.address} did not answer within {CONNECT_TIMEOUT_S:g} s: {error}"
        raise ClusterError(msg) from error
    with client:
        yield client


def run_jobs(
    client: "Client", jobs: Sequence[ClusterJob], out: Path, on_report: OnReport, on_finished: OnFinished
) -> None:
    """Run all jobs, and call back in this thread; SIGTERM is handled like Ctrl-C.

    Parameters
    ----------
    out
        Folder on the shared file system; each attempt writes into a folder below ``out/.cluster-ID``, which is removed.

    Raises
    ------
    ClusterError
        A worker is there that cannot take part, or the scheduler was lost.
    """
    run_id = uuid.uuid4().hex
    staging = out.absolute() / f"{STAGING}{run_id[:12]}"
    staging.mkdir(parents=True)
    try:
        (staging / MARKER).touch()
        with _Run(client, run_id, staging) as run, _terminated_as_interrupted():
            run.refuse_unfit_workers()
            run.do_all(jobs, on_report, on_finished)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


class _Run:
    """One run: its futures, and what arrives from the scheduler, in order, for the caller's thread."""

    def __init__(self, client: "Client", run_id: str, staging: Path) -> None:
        self._client = client
        self._staging = staging
        self._topic = f"tidegate-{run_id}"
        self._run_id = run_id
        self._ticket = {
            "run": run_id,
            "topic": self._topic,
            "staging": str(staging),
            "identity": identity(),
        }
        self._arrived: queue.SimpleQueue[tuple[int, Future[Any] | dict[str, Any]]] = queue.SimpleQueue()
        self._open: dict[int, Future[Any]] = {}
        self._refusals: dict[int, int] = {}

    def __enter__(self) -> "_Run":
        self._client.subscribe_topic(self._topic, self._hear)
        return self

    def __exit__(self, *_: object) -> None:
        """Cancel what is open, and wait until the workers have stopped writing."""
        if self._client.status != "running":
            return
        self._client.unsubscribe_topic(self._topic)
        if self._open:
            self._client.cancel(list(self._open.values()), force=True)
            self._client.run(stop_run, self._run_id, on_error="ignore")

    def refuse_unfit_workers(self) -> None:
        """Raise ClusterError naming each connected worker that cannot take part."""
        unfit = self._unfit()
        if unfit:
            raise ClusterError("; ".join(f"worker {worker} {reason}" for worker, reason in sorted(unfit.items())))
        if not self._client.scheduler_info(n_workers=-1)["workers"]:
            say("No worker is connected yet; waiting for the first one", "yellow")

    def do_all(self, jobs: Sequence[ClusterJob], on_report: OnReport, on_finished: OnFinished) -> None:
        """Submit the jobs and handle what arrives until each has ended."""
        payloads = [pickle.dumps(job) for job in jobs]
        for position, payload in enumerate(payloads):
            self._submit(position, payload)
        while self._open:
            position, message = self._arrived.get()
            if isinstance(message, dict):
                if position in self._open:
                    on_report(position, message)
            elif self._open.get(position) is message:
                finished = self._finished(position, message)
                if finished is None:
                    self._submit(position, payloads[position])
                    continue
                del self._open[position]
                on_finished(position, finished)

    def _submit(self, position: int, payload: bytes) -> None:
        # A job has effects: the same one submitted again is another one.
        future = self._client.submit(run_job, self._ticket, position, payload, pure=False, priority=-position)
        self._open[position] = future
        future.add_done_callback(lambda done: self._arrived.put((position, done)))

    def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        self._arrived.put((event[1]["position"], event[1]))

    def _finished(self, position: int, future: "Future[Any]") -> Finished | None:
        """Return how a job ended; None if it has to be submitted again, because its worker was refused."""
        if future.status == "finished":
            result = future.result()
            if isinstance(result, JobDone):
                return Finished(value=result.value, folder=self._staging / result.folder, files=result.files)
            return Finished(failure=result.reason)
        if future.status != "error":
            raise ClusterError("the scheduler was lost, or cancelled the run; what is complete is kept")
        error = future.exception()
        if isinstance(error, OTHER_VERSION) and self._refusals.get(position, 0) < MAX_REFUSALS:
            self._refusals[position] = self._refusals.get(position, 0) + 1
            self._retire_unfit_workers()
            return None
        return Finished(failure=_words(error))

    def _unfit(self) -> dict[str, str]:
        """Return the workers that cannot take part, each with the reason."""
        found = self._client.run(examine, self._ticket, on_error="return")
        return {
            worker: f"has no Tidegate that can work for this one ({one})" if isinstance(one, Exception) else one
            for worker, one in found.items()
            if one is not None
        }

    def _retire_unfit_workers(self) -> None:
        """Send away workers that joined later and cannot take part; the run goes on with the others."""
        unfit = self._unfit()
        for worker, reason in unfit.items():
            say(f"Refused: worker {worker} {reason}", "yellow")
        if unfit:
            with contextlib.suppress(OSError):
                self._client.retire_workers(list(unfit))


def _words(error: BaseException | None) -> str:
    from distributed.scheduler import KilledWorker

    if isinstance(error, KilledWorker):
        return f"{error.allowed_failures + 1} workers ended early while they did this job"
    return f"{type(error).__name__}: {error}"


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
