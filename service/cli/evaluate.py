"""``tidegate evaluate``: how good the measurement is, judged by instruments; one module a subcommand."""

import typer

from service.cli.evaluate_ablations import ablations
from service.cli.evaluate_bench import bench
from service.cli.evaluate_breathing import breathing
from service.cli.evaluate_gate import gate
from service.cli.evaluate_laser import laser, plane
from service.cli.evaluate_spirometer import spirometer

evaluate = typer.Typer(
    name="evaluate",
    help="How good the measurement is, judged by instruments.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)
evaluate.callback(invoke_without_command=True)(bench)
evaluate.command("ablations")(ablations)
evaluate.command("gate")(gate)
evaluate.command("breathing")(breathing)
evaluate.command("laser")(laser)
evaluate.command("plane")(plane)
evaluate.command("spirometer")(spirometer)
