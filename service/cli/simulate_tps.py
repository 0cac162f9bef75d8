"""``tidegate simulate-tps``: a simulated planning system runs whole fractions over HTTP against a running service.

It is outside of the service in every way: what it knows it knows from HTTP, with a key's permissions, through the
client that planning systems are given (`service.client`). For research and commissioning: nothing is treated.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engine.errors import TidegateError
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from service.client import TidegateClient, Window
    from service.tps.fraction import FractionRun
    from service.tps.prescription import Prescription
    from service.tps.stretch import Progress

BUILT_IN = "built-in"
KEY_VARIABLE = "TPS_KEY"
PASSWORD_VARIABLE = "TPS_PASSWORD"  # noqa: S105 - its name
NOT_DELIVERED = 1
PIPED_WIDTH = 140


def simulate_tps(
    url: Annotated[str, typer.Option(help="Address of the service.")] = "http://127.0.0.1:8000",
    key_file: Annotated[
        Path | None, typer.Option(help=f"File with the API key; else the variable {KEY_VARIABLE}. Never an argument.")
    ] = None,
    plan: Annotated[str, typer.Option(help="An RT Plan or RT Ion Plan to import, or `built-in`.")] = BUILT_IN,
    fractions: Annotated[int, typer.Option(help="How many to run, one after another.", min=1, max=200)] = 1,
    first: Annotated[int, typer.Option(help="Number of the first one.", min=1, max=200)] = 1,
    recording: Annotated[
        str | None, typer.Option(help="A recording in one of the service's folders; a live camera when left out.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration to upload; the service's newest when left out.")
    ] = None,
    lower_mm: Annotated[float, typer.Option(help="Lower edge of the window [mm].", min=-100.0, max=100.0)] = -1.5,
    upper_mm: Annotated[float, typer.Option(help="Upper edge of the window [mm].", min=-100.0, max=100.0)] = 2.0,
    beam_seconds: Annotated[
        float | None,
        typer.Option(help="Beam-on time of every beam [s]; else its meterset at 600 MU/min.", min=0.1, max=600.0),
    ] = None,
    operator: Annotated[str, typer.Option(help="For whom the key acts, in the audit.")] = "Simulated therapist",
    acknowledge_as: Annotated[
        str | None,
        typer.Option(help=f"A person who acknowledges faults and resumes; password file or {PASSWORD_VARIABLE}."),
    ] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with that person's password.")] = None,
    ca_file: Annotated[Path | None, typer.Option(help="Certificate authority of the site, PEM.")] = None,
    patience_s: Annotated[float, typer.Option(help="Longest wait for a beam [s].", min=1.0, max=3600.0)] = 120.0,
    out: Annotated[Path, typer.Option(help="Folder for the samples and report.json.")] = Path("tps-report"),
    *,
    is_chaotic: Annotated[
        bool, typer.Option("--chaos", help="Lose answers, send calls twice, break the stream, read slowly.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of the chaos.", min=0, max=2**31)] = 1,
) -> None:
    """Run fractions: import the plan, prepare, learn, set the reference, arm, deliver beam by beam, fetch, check.

    Exit code 0 when all was delivered and everything fits, 1 when not, 2 when it could not be tried.
    """
    from service.client import ClientError
    from service.tps.chaos import UnrulyClient
    from service.tps.report import FractionReport, fraction_table, write_report

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
                    patience_s=patience_s,
                    out=out,
                    bar=bar,
                )
                reports.append(run.run())
            _console().print(fraction_table(reports[-1]))
            if not reports[-1].is_good:
                break
    except (TidegateError, ClientError, OSError) as error:
        raise refused("simulate-tps", error) from error
    chaos = dict(tps.counts) if isinstance(tps, UnrulyClient) else {}
    write_report(out / "report.json", reports, plan=prescription.label, chaos=chaos)
    if chaos:
        say(f"chaos, seed {seed}: {', '.join(f'{name} {count}' for name, count in sorted(chaos.items()))}")
    say(f"report: {out / 'report.json'}")
    if not all(one.is_good for one in reports):
        raise typer.Exit(NOT_DELIVERED)


def _client(
    url: str, key_file: Path | None, operator: str, ca_file: Path | None, chaos_seed: int | None
) -> "TidegateClient":
    from service.client import TidegateClient
    from service.tps.chaos import UnrulyClient

    key = _secret(key_file, KEY_VARIABLE)
    ca = None if ca_file is None else str(ca_file)
    if chaos_seed is None:
        return TidegateClient(url, key=key, operator=operator, ca_file=ca)
    return UnrulyClient(url, key=key, operator=operator, ca_file=ca, seed=chaos_seed)


def _therapist(url: str, name: str, password_file: Path | None, ca_file: Path | None) -> "TidegateClient":
    from service.client import TidegateClient

    client = TidegateClient(url, ca_file=ca_file)
    client.log_in(name, _secret(password_file, PASSWORD_VARIABLE))
    return client


def _secret(file: Path | None, variable: str) -> str:
    from service.tps.errors import TpsError

    found = file.read_text().strip() if file is not None else os.environ.get(variable, "")
    if not found:
        message = f"nothing to log in with: give a file, or set {variable}"
        raise TpsError(message)
    return found


def _prescription(tps: "TidegateClient", plan: str, beam_s: float | None) -> "Prescription":
    from service.tps.prescription import built_in_plan, prescription_of

    content = built_in_plan() if plan == BUILT_IN else Path(plan).read_bytes()
    imported = tps.import_plan(content)
    for note in imported["notes"]:
        say(f"plan: {note}", "yellow")
    return prescription_of(imported, beam_s=beam_s)


def _calibration(tps: "TidegateClient", file: Path | None) -> str:
    from service.tps.errors import TpsError

    if file is not None:
        return tps.upload_calibration(file.read_bytes())["id"]
    newest = next(tps.calibrations(), None)
    if newest is None:
        message = "the service has no calibration: say --calibration FILE"
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
    patience_s: float,
    out: Path,
    bar: Any,  # noqa: ANN401 - rich's bar, or none
) -> "FractionRun":
    from service.tps.fraction import FractionRun, Wishes
    from service.tps.stretch import Manner

    manner = Manner(patience_s=patience_s)
    task = bar.add_task(f"fraction {number}", total=1.0)

    def tell(progress: "Progress") -> None:
        bar.update(task, completed=progress.share, description=f"{number} {progress.stage}: {progress.detail}")

    return FractionRun(
        number=number,
        prescription=prescription,
        wishes=Wishes(source=source, calibration_id=calibration_id, window=window, manner=manner),
        tps=tps,
        therapist=therapist,
        folder=out,
        tell=tell,
    )


def _console() -> Any:  # noqa: ANN401 - rich is imported where it is used
    import sys

    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False)
