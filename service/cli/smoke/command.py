"""``tidegate smoke URL``: check a service from outside, after an installation, an upgrade or a new certificate.

Exit code 0 when every check passed, 1 when one failed, 2 when the options are refused.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.simulate_tps import KEY_VARIABLE, PASSWORD_VARIABLE, PIPED_WIDTH
from service.cli.terminal import refused

if TYPE_CHECKING:
    from service.cli.smoke.results import CheckResult

FAILED = 1
FRACTION_ONLY = "--recording, --calibration and --acknowledge-as go with --fraction, all three"
KEY_NEEDED = "--fraction, --require-frames and --expect-version need a key"


def smoke(
    url: Annotated[str, typer.Argument(help="https://host[:port] of the service.")],
    key_file: Annotated[
        Path | None, typer.Option(help=f"File with an API key; by default the variable {KEY_VARIABLE} holds the key.")
    ] = None,
    ca_file: Annotated[Path | None, typer.Option(help="Certificate of the site's certificate authority, PEM.")] = None,
    expect_version: Annotated[str | None, typer.Option(help="The version that must answer, such as 0.2.0.")] = None,
    min_days: Annotated[
        float, typer.Option(help="Least time to the certificate's end [days].", min=0.0, max=3650.0)
    ] = 14.0,
    watch_s: Annotated[float, typer.Option(help="Time to follow the live stream [s].", min=1.0, max=60.0)] = 3.0,
    max_age_ms: Annotated[
        float, typer.Option(help="Greatest age of a frame when it was sent [ms].", min=10.0, max=10_000.0)
    ] = 500.0,
    timeout_s: Annotated[float, typer.Option(help="Longest silence of the service [s].", min=0.5, max=60.0)] = 10.0,
    recording: Annotated[
        str | None, typer.Option(help="Recording in one of the service's folders, for the fraction.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="Its calibration file.")] = None,
    acknowledge_as: Annotated[
        str | None,
        typer.Option(help=f"Account of the fraction's therapist; password from a file or {PASSWORD_VARIABLE}."),
    ] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the password of that account.")] = None,
    lower_mm: Annotated[float, typer.Option(help="Lower edge of the window [mm].", min=-100.0, max=100.0)] = -3.0,
    upper_mm: Annotated[float, typer.Option(help="Upper edge of the window [mm].", min=-100.0, max=100.0)] = 6.0,
    beam_seconds: Annotated[
        float, typer.Option(help="Beam-on time of each of the two beams [s].", min=0.1, max=60.0)
    ] = 0.8,
    patience_s: Annotated[float, typer.Option(help="Longest wait for a beam [s].", min=1.0, max=600.0)] = 120.0,
    *,
    needs_fraction: Annotated[
        bool, typer.Option("--fraction", help="Deliver a simulated fraction too; simulated beam lines only.")
    ] = False,
    needs_frames: Annotated[
        bool, typer.Option("--require-frames", help="Fail where no session runs, or it has no frames.")
    ] = False,
    is_anonymous: Annotated[bool, typer.Option("--no-key", help="Check liveness and certificate only.")] = False,
    is_plain_http_allowed: Annotated[
        bool, typer.Option("--allow-plain-http", help="Send the key to another machine without TLS.")
    ] = False,
    is_strict: Annotated[bool, typer.Option("--strict", help="Warnings fail too.")] = False,
    is_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Check a running service from outside: certificate, readiness, live stream, a fraction.

    Exit code 0 when every check passed, 1 when one failed, 2 when the options are refused.
    """
    from engine.core.errors import TidegateError
    from service.cli.simulate_tps import secret_from
    from service.cli.smoke.results import as_json, is_passed
    from service.cli.smoke.site import Demands, FractionDemand, Site
    from service.client import UsageError

    of_fraction = (recording, calibration, acknowledge_as)
    if not _is_whole(of_fraction, is_wanted=needs_fraction):
        raise refused("smoke", FRACTION_ONLY)
    if is_anonymous and (needs_fraction or needs_frames or expect_version):
        raise refused("smoke", KEY_NEEDED)
    try:
        site = Site(
            url=url,
            key=None if is_anonymous else secret_from(key_file, KEY_VARIABLE),
            ca_file=ca_file,
            timeout_s=timeout_s,
            is_plain_http_allowed=is_plain_http_allowed,
        )
        site.client().close()  # refuses an address or a key that cannot be one
        fraction = None
        if recording is not None and calibration is not None and acknowledge_as is not None:
            fraction = FractionDemand(
                recording=recording,
                calibration=calibration.read_bytes(),
                therapist=acknowledge_as,
                password=secret_from(password_file, PASSWORD_VARIABLE),
                lower_mm=lower_mm,
                upper_mm=upper_mm,
                beam_s=beam_seconds,
                patience_s=patience_s,
            )
    except (TidegateError, UsageError, OSError) as error:
        raise refused("smoke", error) from error
    demands = Demands(
        version=expect_version, min_days=min_days, watch_s=watch_s, max_age_ms=max_age_ms, needs_frames=needs_frames
    )
    results = site.check(demands, fraction)
    if is_json:
        typer.echo(as_json(url, results, is_strict=is_strict))
    else:
        _print(url, results)
    if not is_passed(results, is_strict=is_strict):
        raise typer.Exit(FAILED)


def _is_whole(of_fraction: tuple[object, ...], *, is_wanted: bool) -> bool:
    """Whether all options of the fraction are given where it is wanted, and none where it is not."""
    return all((one is not None) == is_wanted for one in of_fraction)


def _print(url: str, results: "Sequence[CheckResult]") -> None:
    from rich.console import Console

    from service.cli.smoke.results import as_table

    Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False).print(as_table(url, results))
