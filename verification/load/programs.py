"""The programs that make the load, each in a process of its own: started, asked to begin and to end, and heard."""

import json
import subprocess
import sys
from types import TracebackType
from typing import Any, Self

from tests.support.repository import ROOT
from verification.load.service import LoadError

END_S = 30.0


class LoadProgram:
    """One program from its start to its result; a context manager that leaves none behind."""

    def __init__(self, module: str, asked: dict[str, object]) -> None:
        self._module = module
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is handled by the parent, which still needs the result
        )
        self._say(json.dumps(asked))

    def wait_until_ready(self) -> None:
        """Return when everything it opens is open."""
        self._expect("ready")

    def begin(self) -> None:
        """Let it count from now."""
        self._say("begin")

    def result(self) -> dict[str, Any]:
        """Let it end, and return what it counted."""
        self._say("end")
        found: dict[str, Any] = json.loads(self._expect(None))
        self._process.wait(END_S)
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: type[BaseException] | None, _error: object, _trace: TracebackType | None) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _expect(self, expected: str | None) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        if not line or (expected is not None and line != expected):
            raise LoadError(f"{self._module} ended instead of saying {expected or 'its result'}: {line}")
        return line
