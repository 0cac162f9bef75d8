"""``tidegate simulate-tps``: a simulated planning system runs whole fractions over HTTP against a running service.

It uses only the HTTP API, with the permissions of an API key, through `service.client`. For research and commissioning:
nothing is treated.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engine.core.errors import TidegateError
from engine.core.signals import HeadDirection
from service.cli.secret_files import KEY_VARIABLE, secret_from
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from lab.simulated_tps.fraction import FractionRun
    from lab.simulated_tps.prescription import Prescription
    from lab.simulated_tps.session_driver import Progress
    from service.client import TidegateClient, Window

BUILT_IN = "built-in"
PASSWORD_VARIABLE = "TPS_PASSWORD"  # noqa: S105 - its name
NOT_DELIVERED = 1
PIPED_WIDTH = 140


def simulate_tps(
    url: Annotated[str, typer.Option(help="URL of the service.")] = "http://127.0.0.1:8000",
    key_file: Annotated[
        Path | None, typer.Option(help=f"File with the API key; by default the variable {KEY_VARIABLE} holds the key.")
    ] = None,
    plan: Annotated[str, typer.Option(help="RT Plan or RT Ion Plan file to import, or `built-in`.")] = BUILT_IN,
    fractions: Annotated[int, typer.Option(help="Number of fractions.", min=1, max=200)] = 1,
    first: Annotated[int, typer.Option(help="Number of the first fraction.", min=1, max=200)] = 1,
    recording: Annotated[
        str | None, typer.Option(help="Recording in one of the service's folders; a live camera by default.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file to upload; the service's newest by default.")
    ] = None,
    lower_mm: Annotated[float, typer.Option(help="Lower edge of the window [mm].", min=-100.0, max=100.0)] = -1.5,
    upper_mm: Annotated[float, typer.Option(help="Upper edge of the window [mm].", min=-100.0, max=100.0)] = 2.0,
    head: Annotated[
        HeadDirection | None,
        typer.Option(
            help="Side of the picture at which the patient's head lies; by default it follows from the plan's Patient "
            "Position, if the service has a gantry side."
        ),
    ] = None,
    beam_seconds: Annotated[
        float | None,
        typer.Option(help="Beam-on time of every beam; by default its meterset at 600 MU/min [s].", min=0.1, max=600.0),
    ] = None,
    operator: Annotated[
        str, typer.Option(help="Person named in the audit log for the calls of the key.")
    ] = "Simulated therapist",
    acknowledge_as: Annotated[
        str | None,
        typer.Option(
            help=f"Account that acknowledges faults and resumes; password from a file or {PASSWORD_VARIABLE}."
        ),
    ] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the password of that account.")] = None,
    ca_file: Annotated[Path | None, typer.Option(help="Certificate of the site's certificate authority, PEM.")] = None,
    patience_s: Annotated[float, typer.Option(help="Longest wait for a beam [s].", min=1.0, max=3600.0)] = 120.0,
    out: Annotated[Path, typer.Option(help="Folder for the samples and report.json.")] = Path("tps-report"),
    *,
    is_chaotic: Annotated[
        bool, typer.Option("--chaos", help="Inject faults: lose answers, repeat calls, break the stream, read slowly.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the injected faults.", min=0, max=2**31)] = 1,
) -> None:
    """Simulate a treatment planning system: run whole fractions against a running service.

    For every fraction: import the plan, open a session, train, set the reference, arm, deliver beam by beam, fetch the
    samples and check them.

    Exit code 0 when every beam was delivered and every check passed, 1 when not, 2 when the run could not start.
    """
    from lab.simulated_tps.delivery import FaultInjectingClient
    from lab.simulated_tps.report import FractionReport, fraction_table, write_report
    from service.client import ClientError

    try:
        out.mkdir(parents=True, exist_ok=True)
        tps = _client(url, key_file, operator, ca_file, seed if is_chaotic else None)
        therapist = None if acknowledge_as is None else _therapist(url, acknowledge_as, password_file, ca_file)
        prescription = _prescription(tps, plan, beam_seconds)
        reports: list[FractionReport] = []
        for number in range(first, first + fractions):
            with frame_bar() as bar:
                run = _run(
                    number,
                    prescription,
                    tps=tps,
                    therapist=therapist,
                    source=_source(recording),
                    calibration_id=_calibration(tps, calibration),
                    window={"signal": "whole", "lower_mm": lower_mm, "upper_mm": upper_mm},
                    head=head,
                    patience_s=patience_s,
                    out=out,
                    bar=bar,
                )
                reports.append(run.run())
            _console().print(fraction_table(reports[-1]))
            for trouble in reports[-1].all_troubles:
                say(f"fraction {number}: {trouble}", "red")
            if not reports[-1].is_good:
                break
    except (TidegateError, ClientError, OSError) as error:
        raise refused("simulate-tps", error) from error
    chaos = dict(tps.counts) if isinstance(tps, FaultInjectingClient) else {}
    write_report(out / "report.json", reports, plan=prescription.label, chaos=chaos)
    if chaos:
        say(f"injected faults, seed {seed}: {', '.join(f'{name} {count}' for name, count in sorted(chaos.items()))}")
    say(f"report: {out / 'report.json'}")
    if not all(one.is_good for one in reports):
        raise typer.Exit(NOT_DELIVERED)


def _client(
    url: str, key_file: Path | None, operator: str, ca_file: Path | None, chaos_seed: int | None
) -> "TidegateClient":
    from lab.simulated_tps.delivery import FaultInjectingClient
    from service.client import TidegateClient

    key = secret_from(key_file, KEY_VARIABLE)
    ca = None if ca_file is None else str(ca_file)
    if chaos_seed is None:
        return TidegateClient(url, key=key, operator=operator, ca_file=ca)
    return FaultInjectingClient(url, key=key, operator=operator, ca_file=ca, seed=chaos_seed)


def _therapist(url: str, name: str, password_file: Path | None, ca_file: Path | None) -> "TidegateClient":
    from service.client import TidegateClient

    client = TidegateClient(url, ca_file=ca_file)
    client.log_in(name, secret_from(password_file, PASSWORD_VARIABLE))
    return client


def _prescription(tps: "TidegateClient", plan: str, beam_s: float | None) -> "Prescription":
    from lab.simulated_tps.prescription import built_in_plan, prescription_of

    content = built_in_plan() if plan == BUILT_IN else Path(plan).read_bytes()
    imported = tps.import_plan(content)
    for note in imported["notes"]:
        say(f"plan: {note}", "yellow")
    return prescription_of(imported, beam_s=beam_s)


def _calibration(tps: "TidegateClient", file: Path | None) -> str:
    from lab.simulated_tps.prescription import TpsError

    if file is not None:
        return tps.upload_calibration(file.read_bytes())["id"]
    newest = next(tps.calibrations(), None)
    if newest is None:
        message = "the service has no calibration: give --calibration FILE"
        raise TpsError(message)
    return newest["id"]


def _source(recording: str | None) -> Any:  # noqa: ANN401 - one of two shapes
    if recording is None:
        return {"kind": "device"}
    return {"kind": "recording", "path": recording, "player": "reader"}


def _run(
    number: int,
    prescription: "Prescription",
    *,
    tps: "TidegateClient",
    therapist: "TidegateClient | None",
    source: Any,  # noqa: ANN401 - one of two shapes
    calibration_id: str,
    window: "Window",
    head: HeadDirection | None,
    patience_s: float,
    out: Path,
    bar: Any,  # noqa: ANN401 - rich's bar, or none
) -> "FractionRun":
    from lab.simulated_tps.fraction import FractionRun, FractionSettings
    from lab.simulated_tps.session_driver import DeliverySettings

    delivery = DeliverySettings(beam_timeout_s=patience_s)
    task = bar.add_task(f"fraction {number}", total=1.0)

    def show(progress: "Progress") -> None:
        bar.update(task, completed=progress.share, description=f"{number} {progress.stage}: {progress.detail}")

    return FractionRun(
        number=number,
        prescription=prescription,
        settings=FractionSettings(
            source=source,
            calibration_id=calibration_id,
            window=window,
            delivery=delivery,
            head_direction=None if head is None else head.value,
        ),
        tps=tps,
        therapist=therapist,
        folder=out,
        on_progress=show,
    )


def _console() -> Any:  # noqa: ANN401 - rich is imported where it is used
    import sys

    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False)
