"""How a command starts: with what it needs, and nothing that only others need."""

import subprocess
import sys

import pytest

from service.cli.terminal import NoBar, frame_bar, say

HEAVY = (
    "rich",
    "sqlalchemy",
    "fastapi",
    "pydantic",
    "matplotlib",
    "scipy.signal",
    "scipy.interpolate",
    "scipy.ndimage",
)


def test_measuring_loads_nothing_that_only_other_commands_need():
    program = f"import sys, service.cli.measure.command; print([name for name in {HEAVY} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def test_no_progress_bar_is_drawn_without_a_terminal(capsys):
    with frame_bar() as bar:
        task = bar.add_task("training", total=None)
        bar.update(task, completed=3, total=9, description="measuring")
    assert isinstance(bar, NoBar)
    assert capsys.readouterr() == ("", "")


def test_a_bar_is_drawn_on_a_terminal(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert not isinstance(frame_bar(), NoBar)


@pytest.mark.parametrize("text", ["[red]brackets[/red] stay", "one line, " + "however long " * 30])
def test_a_line_is_printed_exactly_as_it_is(text, capsys):
    say(text, "red")
    assert capsys.readouterr().err == text + "\n"


@pytest.mark.parametrize(
    ("module", "unneeded"),
    [
        (
            "service.engine_host.process.engine_server",
            (
                *(
                    "fastapi",
                    "sqlalchemy",
                    "pyarrow.lib",
                    "matplotlib",
                    "scipy",
                    "psycopg",
                    "pydicom",
                    "rich",
                    "alembic",
                ),
                "pymodbus",
            ),
        ),
        (
            "service.web.app",
            (
                *("matplotlib", "pyarrow.lib", "scipy", "psycopg", "pydicom", "rich", "lab"),
                *("alembic", "authlib", "joserfc", "httpx2", "cryptography"),
                *("pymodbus", "sqlalchemy.dialects.postgresql"),
            ),
        ),
    ],
)
def test_each_process_of_the_service_loads_only_what_it_uses(module, unneeded):
    program = (
        "import sys; from service.core.late_modules import load_when_used;"
        "from service.cli.serve import LATE_LIBRARIES;"
        f"load_when_used(*LATE_LIBRARIES); import {module};"
        f"print([name for name in {unneeded} if name in sys.modules],"
        "[name for name in LATE_LIBRARIES if not sys.modules[name].__is_late__])"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[] []"
