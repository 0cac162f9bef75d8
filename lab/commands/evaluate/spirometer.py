"""``tidegate evaluate spirometer``: the measured volume compared with a spirometer."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from engine.calibration import load_calibration
from engine.core.errors import TidegateError
from engine.core.frames import FloatArray, Measurement, RgbdFrame
from engine.motion import PipelineSettings, TrainingSettings
from lab.commands.evaluate.instruments import draw_spirometer, number, superior_of, watch, write_rows
from lab.evaluation.instruments.flow_file import read_flow
from lab.evaluation.instruments.spirometer import (
    MAX_LAG_S,
    SpirometerComparison,
    check_max_lag,
    compare_volumes,
    to_unit_range,
)
from service.cli.terminal import refused, say

HEADER = (
    "frame_index",
    "timestamp_us",
    "tidegate_l",
    "spirometer_l",
    "tidegate_scaled",
    "spirometer_scaled",
)


def spirometer(
    recording: Annotated[Path, typer.Argument(help="An .oni recording.", metavar="REC.oni")],
    flow: Annotated[
        Path,
        typer.Argument(help="Two columns, time_s or time_ms and flow_l_per_s or volume_l.", metavar="FLOW.csv"),
    ],
    calibration: Annotated[Path, typer.Option(help="Calibration of the cameras (tidegate.calibration/1).")],
    out: Annotated[Path, typer.Option(help="Folder for spirometer.csv and spirometer.png.")],
    max_lag_s: Annotated[float, typer.Option(help="Search range of the lag, in both directions [s].")] = MAX_LAG_S,
    exhale_positive: Annotated[
        bool, typer.Option("--exhale-positive", help="The spirometer counts exhaled air as positive.")
    ] = False,
    components: Annotated[int, typer.Option(help="Largest number of principal components of the motion model.")] = 6,
    head: Annotated[
        str, typer.Option(help="Direction of the head in the picture: auto, up, down, left or right.")
    ] = "auto",
) -> None:
    """Compare the measured volume with a spirometer's recording of the same breaths (article, section 4.5.1).

    Finds the lag between both clocks. Writes spirometer.csv and spirometer.png, and prints lag, correlation and scale.
    """
    try:
        check_max_lag(max_lag_s)
        cameras, spirometry = load_calibration(calibration), read_flow(flow)
        settings = PipelineSettings(superior_px=superior_of(head), training=TrainingSettings(components=components))
        seen: list[tuple[int, int, float]] = []

        def on_frame(_frame: RgbdFrame, measurement: Measurement) -> None:
            volume_l = float("nan") if measurement.motion is None else measurement.motion.volume_l
            seen.append((measurement.frame_index, measurement.timestamp_us, volume_l))

        watch(recording, cameras, settings, on_frame)
        time_s = np.array([time_us - seen[0][1] for _, time_us, _ in seen]) * 1e-6
        volume_l = np.array([volume for _, _, volume in seen])
        found = compare_volumes(time_s, volume_l, spirometry, max_lag_s=max_lag_s, is_exhale_positive=exhale_positive)
        out.mkdir(parents=True, exist_ok=True)
        _write(seen, found, out / "spirometer.csv")
        draw_spirometer(time_s, found, out / "spirometer.png")
    except TidegateError as error:
        raise refused("evaluate spirometer", error) from error
    except OSError as error:
        raise refused("evaluate spirometer", f"{out} cannot be written ({error.strerror or error})") from error
    _print(found)
    for notice in found.notices:
        say(f"Note: {notice}", "yellow")
    say(f"Written to {out}")


def _write(seen: list[tuple[int, int, float]], found: SpirometerComparison, path: Path) -> None:
    columns: list[FloatArray] = [
        found.tidegate_l,
        found.spirometer_l,
        to_unit_range(found.tidegate_l),
        to_unit_range(found.spirometer_l),
    ]
    write_rows(
        path,
        HEADER,
        (
            [index, time_us, *(number(value, 6) for value in values)]
            for (index, time_us, _), values in zip(seen, np.column_stack(columns), strict=True)
        ),
    )


def _print(found: SpirometerComparison) -> None:
    table = Table(title="Tidegate against the spirometer", title_justify="left", show_header=False, show_edge=False)
    table.add_column()
    table.add_column(justify="right")
    table.add_row("lag: spirometer time minus recording time, in s", f"{found.lag_s:.3f}")
    table.add_row("common duration, in s", f"{found.overlap_s:.1f}")
    table.add_row("correlation", f"{found.correlation:.4f}")
    table.add_row("scale: Tidegate volume per spirometer volume", f"{found.scale:.3f}")
    table.add_row(
        "error after that scale, mean and deviation, in % of the range",
        f"{found.error_percent:.2f} +- {found.error_deviation_percent:.2f}",
    )
    Console().print(table)
