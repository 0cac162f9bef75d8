"""Libraries that are loaded when they are used."""

import subprocess
import sys
import textwrap

import pytest

from service.core.late_modules import load_when_used

PACKAGE = {
    "__init__.py": """
        import threading
        loaded_by = [threading.current_thread().name]
        threading.Event().wait(0.2)  # another thread must not see what is not there yet
        from slow_library import part
        size = part.size
        """,
    "part.py": """
        import slow_library
        size = 7
        """,
}


@pytest.fixture
def library(tmp_path):
    folder = tmp_path / "slow_library"
    folder.mkdir()
    for name, text in PACKAGE.items():
        (folder / name).write_text(textwrap.dedent(text))

    def run(program):
        start = (
            "import sys, threading\n"
            "from service.core.late_modules import load_when_used, when_loaded\n"
            f"sys.path.insert(0, {str(tmp_path)!r})\n"
            "load_when_used('slow_library')\n"
            "import slow_library\n"
            "def is_loaded(): return 'loaded_by' in vars(slow_library)\n"
        )
        command = [sys.executable, "-c", start + textwrap.dedent(program)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout.split()

    return run


def test_a_library_is_loaded_when_a_name_of_it_is_read(library):
    assert library("print(is_loaded(), slow_library.size, is_loaded())") == ["False", "7", "True"]


def test_whoever_imports_a_part_of_it_has_all_of_it(library):
    assert library("import slow_library.part as part; print(is_loaded(), part.size)") == ["True", "7"]


def test_a_name_that_it_does_not_have_is_an_error_as_in_any_module(library):
    program = """
        for _ in range(2):
            try:
                slow_library.colour
            except AttributeError as error:
                print(str(error).replace(" ", "-"))
        """
    assert library(program) == ["module-'slow_library'-has-no-attribute-'colour'"] * 2


def test_threads_that_use_it_at_the_same_time_see_all_of_it_and_load_it_once(library):
    program = """
        found = []
        threads = [threading.Thread(target=lambda: found.append(slow_library.size)) for _ in range(8)]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        print(len(slow_library.loaded_by), *found)
        """
    assert library(program) == ["1", *"77777777"]


def test_what_is_to_be_done_then_is_done_once_and_at_once_where_it_is_loaded(library):
    program = """
        when_loaded("slow_library", lambda: print("loaded"))
        print("before")
        slow_library.size, slow_library.part
        when_loaded("slow_library", lambda: print("now"))
        """
    assert library(program) == ["before", "loaded", "now"]


def test_before_a_session_all_is_loaded(library):
    program = """
        from service.core.late_modules import load_now
        load_now()
        print(is_loaded())
        load_now()
        print(len(slow_library.loaded_by))
        """
    assert library(program) == ["True", "1"]


def test_a_library_that_is_not_installed_is_named():
    with pytest.raises(ModuleNotFoundError) as raised:
        load_when_used("no_such_library")
    assert raised.value.name == "no_such_library"
