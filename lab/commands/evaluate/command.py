"""``tidegate evaluate``: how good the measurement is, judged by instruments; one module a subcommand."""

from lab.commands.evaluate.bench import bench
from lab.commands.evaluate.breathing import breathing, gate
from lab.commands.evaluate.integrity import ablations, budget, draws, integrity, sensor, tune
from lab.commands.evaluate.laser import laser, plane
from lab.commands.evaluate.spirometer import spirometer
from service.cli.command_group import command_group

evaluate = command_group(
    "evaluate", "Measure the accuracy of the motion on virtual volunteers and against instruments."
)
evaluate.callback(invoke_without_command=True)(bench)
evaluate.command("ablations")(ablations)
evaluate.command("budget")(budget)
evaluate.command("draws")(draws)
evaluate.command("gate")(gate)
evaluate.command("breathing")(breathing)
evaluate.command("integrity")(integrity)
evaluate.command("laser")(laser)
evaluate.command("plane")(plane)
evaluate.command("sensor")(sensor)
evaluate.command("spirometer")(spirometer)
evaluate.command("tune")(tune)
