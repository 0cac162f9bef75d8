"""What a stranger may rely on: names and signatures, how light the import is, and whose packages are imported."""

import subprocess
import sys
from pathlib import Path

import pytest

import tidegate
from tests.tidegate.signatures import FILE, exported, unnamed_removals

ROOT = Path(__file__).parents[2]


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)


def test_names_and_signatures_are_those_of_the_file():
    assert exported() == FILE.read_text(), "run python -m tests.tidegate.signatures"
    assert len(tidegate.__all__) <= 40


@pytest.mark.parametrize("name", tidegate.__all__)
def test_every_name_is_there_and_described(name):
    assert getattr(tidegate, name).__doc__


@pytest.mark.parametrize(
    ("now", "changelog", "unnamed"),
    [
        ("gate(signal, window)\n", "", []),
        ("gate(signal)\n", "\n## [1]\n- nothing\n## [0]\n- `window`", ["gate window"]),
        ("gate(signal)\n", "\n## [1]\n- `window` of `gate` is gone\n## [0]", []),
        ("", "\n## [1]\n- `gate` is gone, with `signal` and `window`\n", []),
    ],
)
def test_what_goes_is_named_in_the_changelog(now, changelog, unnamed):
    assert unnamed_removals("gate(signal, window)\n", now, changelog) == unnamed


def test_an_import_loads_nothing_heavy():
    heavy = ["numpy", "cv2", "scipy", "pyarrow", "fastapi", "service", "matplotlib"]
    code = f"import sys, tidegate; print([name for name in {heavy} if name in sys.modules])"
    assert run(code, ROOT).stdout == "[]\n"


def test_another_distribution_s_engine_is_named(tmp_path):
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "__init__.py").write_text("__version__ = '9'")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import tidegate"
    ended = run(code, tmp_path)
    assert ended.returncode == 1
    assert f"ImportError: the package 'engine' is not Tidegate's: it is at {tmp_path}" in ended.stderr


def test_what_is_not_there_is_no_name():
    with pytest.raises(AttributeError, match="no attribute 'beam_on'"):
        _ = tidegate.beam_on


def test_types_are_published():
    assert Path(tidegate.__file__).with_name("py.typed").exists()
