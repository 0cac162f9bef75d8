"""The structure of the code: constants on top, budgets of lines and words, imports of tests, paths that builds name."""

import ast
import builtins
import re
import tomllib

import pytest

from tests.support.repository import ROOT
from tests.support.selection import PARTS, SLOW_FOLDERS, module_marks

TESTS = ROOT / "tests"
MODULES = sorted(
    path for folder in (TESTS, ROOT / "verification") for path in folder.rglob("*.py") if "data" not in path.parts
)
TEST_MODULE = re.compile(r"^(?:tests|verification)(\.\w+)*\.(test_\w+|conftest)$")
PRODUCT = sorted(path for name in ("engine", "service", "lab") for path in (ROOT / name).rglob("*.py"))
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
BUDGETS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["tidegate"]
MOST_WORDS_OF_A_DECISION = 450
NAMED_PATH = re.compile(r"(?<![\w./-])(?:tests|verification)/[\w/]+(?:\.\w+)?")


SLEEPS = {
    "verification/virtual_camera/test_realsense.py": "an engine that takes no frames for a while",
    "verification/faults/test_cleanup.py": "the program that is killed, and a wait for its remains",
    "verification/faults/test_wall_clock.py": "the clock under test is compared with real time",
    "tests/service/cli/test_qa.py": "the line stays off for 0.5 s",
    "tests/service/sessions/recovery/test_journal.py": "the program that is killed",
    "tests/system/engine_process/test_killed_engine.py": "a command grows too old in another process",
    "verification/virtual_camera/test_faults.py": "a camera delivers nothing for 0.3 s",
    "verification/virtual_camera/test_sdk_sessions.py": "the beam stays off for 0.5 s on a camera's clock",
    "verification/virtual_camera/test_live_session.py": "the beam stays off for 0.5 s on a real camera's clock",
}
"""Test modules that sleep, and why: nothing can be waited for. Others wait with tests/support/waiting.py."""


MAY_IMPORT = re.compile(
    r"^\s*(?:from|import)\b.*\b(?:test_\w+|conftest)\b|^\s+(?:test_\w+|conftest)\b[^(]*$", re.MULTILINE
)
"""Where no line looks like such an import, a module need not be parsed: all of them take seconds."""


def imported_test_modules(source: str) -> set[str]:
    """Return the test modules and conftests that a source imports, as absolute names."""
    named = set()
    for node in ast.walk(ast.parse(source)) if MAY_IMPORT.search(source) else ():
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            named |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in named if TEST_MODULE.match(name)}


def test_no_module_imports_a_test_module_or_a_conftest():
    found = {str(path.relative_to(ROOT)): imported_test_modules(path.read_text(encoding="utf-8")) for path in MODULES}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "line",
    [
        "import tests.a.test_b",
        "from tests.a.test_b import c",
        "from tests.a import conftest",
        "from tests.conftest import d",
        "from tests.a import (\n        support,\n        test_b,\n    )",
    ],
)
def test_an_import_of_a_test_module_is_found_in_each_form(line):
    assert imported_test_modules(f"def late():\n    {line}\n")


def test_only_the_listed_test_modules_sleep():
    modules = {str(path.relative_to(ROOT)): path for path in MODULES if path.name.startswith("test_")}
    sleeping = {
        name for name, path in modules.items() if re.search(r"^\s*time\.sleep\(", path.read_text(), re.MULTILINE)
    }
    assert sleeping == SLEEPS.keys()


def test_no_test_module_compiles_grammars_where_it_is_collected():
    """Every process of every run would: tests/support/contract/schemas.py imports jsonschema where a test validates."""
    found = [path for path in MODULES if re.search(r"^(from|import) jsonschema\b", path.read_text(), re.MULTILINE)]
    assert found == []


def test_make_check_runs_some_tests_of_every_package():
    modules = [path for path in MODULES if path.name.startswith("test_") and TESTS in path.parents]
    others = {path for path in modules if not module_marks(path).isdisjoint({"slow", *PARTS})}
    others |= {path for path in modules if not set(SLOW_FOLDERS).isdisjoint(path.parents)}
    fast = {path.relative_to(TESTS).parts[:2] for path in modules if path not in others}
    packages = {path.relative_to(TESTS).parts[:2] for path in modules if len(path.relative_to(TESTS).parts) > 2}
    assert {package for package in packages if package[0] in {"engine", "service"}} - fast == set()


def test_every_folder_of_tests_is_a_package():
    """Else two test files of the same name collide."""
    assert [str(path.parent) for path in MODULES if not (path.parent / "__init__.py").exists()] == []


@pytest.mark.parametrize("file", ["Makefile", "pyproject.toml"])
def test_every_path_of_a_test_that_a_build_names_exists(file):
    named = set(NAMED_PATH.findall((ROOT / file).read_text(encoding="utf-8")))
    assert named
    assert [path for path in sorted(named) if not (ROOT / path).exists()] == []


def test_a_run_of_a_part_takes_the_modules_that_are_marked_so_and_no_other(pytester):
    marks = {
        "a": "",
        "b": "pytestmark = pytest.mark.waiting",
        "c": "pytestmark = [\n    pytest.mark.alone,\n    pytest.mark.long,\n]",
    }
    for name, line in {**marks, "d": "pytestmark = pytest.mark.slow"}.items():
        pytester.makepyfile(**{f"test_{name}": f"import pytest\n{line}\ndef test_one():\n    pass\n"})
    pytester.makeini("[pytest]\nmarkers =\n    waiting\n    alone\n    slow\n    long\n    both_databases\n")
    taken = {}
    for given in (("--part", "computing"), ("--part", "waiting"), ("--part", "alone"), ("--fast",), ()):
        items, _ = pytester.inline_genitems("-p", "tests.support.selection", *given)
        taken[given[-1] if given else ""] = "".join(item.module.__name__[-1] for item in items)
    assert taken == {"computing": "ad", "waiting": "b", "alone": "c", "--fast": "a", "": "abcd"}


def test_every_module_is_of_one_part():
    modules = [path for path in MODULES if path.name.startswith("test_")]
    assert [path for path in modules if len(module_marks(path) & set(PARTS)) > 1] == []


def names_in(*nodes: ast.AST, bound: bool = False) -> set[str]:
    """Return the names that are read, or bound, anywhere in the nodes."""
    of_kind = ast.Store if bound else ast.Load
    found = {
        one.id for node in nodes for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, of_kind)
    }
    if bound:
        every = [one for node in nodes for one in ast.walk(node)]
        found |= {one.arg for one in every if isinstance(one, ast.arg)}
        found |= {(one.asname or one.name).split(".")[0] for one in every if isinstance(one, ast.alias)}
    return found


def late_constants(source: str) -> list[str]:
    """Return the module constants that stand below a definition although they need none of the module."""
    body = ast.parse(source).body
    first = next((place for place, node in enumerate(body) if isinstance(node, DEFINITIONS)), len(body))
    known = set(dir(builtins)) | {"__name__", "__file__"} | names_in(*body[:first], bound=True)
    late = []
    for node in body[first:]:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if names_in(node) - names_in(node, bound=True) <= known and all(isinstance(one, ast.Name) for one in targets):
            late += sorted(names_in(*targets, bound=True))
            known |= names_in(*targets, bound=True)
    return late


def test_constants_stand_above_the_first_definition():
    """A second block of constants shows two modules that were put into one file."""
    written = [path for path in PRODUCT if path != ROOT / "service/client.py"]  # one file on purpose, the types made
    found = {str(path.relative_to(ROOT)): late_constants(path.read_text(encoding="utf-8")) for path in written}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("below", "late"),
    [
        ("B = A + 1", ["B"]),
        ("B: int = len([n for n in range(A)])", ["B"]),
        ("B = {A: f}", []),
        ("B = f(A)\nC = B", []),
        ("B = A\nC = B", ["B", "C"]),
    ],
    ids=["a number", "a comprehension", "a table of functions", "made by a function", "one of another"],
)
def test_a_constant_is_late_unless_it_needs_what_is_defined_above_it(below, late):
    assert late_constants(f"A = 1\ndef f(a): return a\n{below}\n") == late


def lines_of(folder: str) -> int:
    return sum(path.read_text(encoding="utf-8").count("\n") for path in (ROOT / folder).rglob("*.py"))


def words_of(folder: str) -> int:
    return sum(len(path.read_text(encoding="utf-8").split()) for path in (ROOT / folder).rglob("*.md"))


@pytest.mark.parametrize("folder", BUDGETS["lines"])
def test_code_is_within_its_budget(folder):
    """A budget is raised only in a change whose ADR says what was taken out for it."""
    assert lines_of(folder) <= BUDGETS["lines"][folder]


@pytest.mark.parametrize("decision", sorted((ROOT / "docs/adr").glob("0*.md")), ids=lambda path: path.name[:4])
def test_a_decision_is_a_page_at_most(decision):
    assert len(decision.read_text(encoding="utf-8").split()) <= MOST_WORDS_OF_A_DECISION


@pytest.mark.parametrize("folder", BUDGETS["words"])
def test_documents_are_within_their_budget(folder):
    assert words_of(folder) <= BUDGETS["words"][folder]


def test_every_package_and_every_folder_of_documents_has_a_budget():
    """Of the large folders the next level has one each, so that one cannot grow on what another lost."""
    packages = {
        f"{top}/{path.name}" for top in ("engine", "service") for path in (ROOT / top).iterdir() if path.is_dir()
    }
    assert BUDGETS["lines"].keys() == {name for name in packages if lines_of(name)} | {
        "lab",
        "tests",
        "tidegate",
        "verification",
    }
    assert BUDGETS["words"].keys() == {
        f"docs/{path.name}" for path in (ROOT / "docs").iterdir() if words_of(f"docs/{path.name}")
    }


def test_the_lab_s_wheel_has_every_package_of_it():
    lab = tomllib.loads((ROOT / "lab/pyproject.toml").read_text(encoding="utf-8"))
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "lab").rglob("__init__.py")}
    assert set(lab["tool"]["setuptools"]["packages"]) == folders
