"""``tidegate evaluate``: how good the measurement is, judged by instruments; one module a subcommand."""

from service.cli.command_group import command_group
from service.cli.evaluate.bench import bench
from service.cli.evaluate.breathing import breathing, gate
from service.cli.evaluate.integrity import ablations, budget, integrity
from service.cli.evaluate.laser import laser, plane
from service.cli.evaluate.spirometer import spirometer

evaluate = command_group(
    "evaluate", "Measure the accuracy of the motion on virtual volunteers and against instruments."
)
evaluate.callback(invoke_without_command=True)(bench)
evaluate.command("ablations")(ablations)
evaluate.command("budget")(budget)
evaluate.command("gate")(gate)
evaluate.command("breathing")(breathing)
evaluate.command("integrity")(integrity)
evaluate.command("laser")(laser)
evaluate.command("plane")(plane)
evaluate.command("spirometer")(spirometer)
