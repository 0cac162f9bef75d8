"""What proves the product: the command line finds it by the entry point ``tidegate.commands``."""

from service.cli.command_group import Command

COMMANDS = {
    "phantom": Command(
        "lab.commands.phantom", "Generate a recording of a virtual volunteer, with its calibration and true motion."
    ),
    "demo": Command(
        "lab.commands.demo.command", "Run a gated session on a virtual volunteer and compare it with the true motion."
    ),
    "evaluate": Command(
        "lab.commands.evaluate.command",
        "Measure the accuracy of the motion on virtual volunteers and against instruments.",
    ),
    "bench": Command(
        "lab.commands.bench", "Measure the speed of every processing stage and the memory use on this machine."
    ),
    "simulate-tps": Command(
        "lab.commands.simulate_tps",
        "Simulate a treatment planning system: run whole fractions against a running service.",
    ),
}
"""As `service.cli.COMMANDS`."""
