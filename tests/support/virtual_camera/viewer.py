"""A process of its own that reads a virtual Xtion through the runtime, and what it has said so far."""

import json
import os
import subprocess
import sys
import threading
from typing import Any, Self

from tests.support.repository import ROOT
from tests.support.virtual_camera.camera import PATIENCE_S, VirtualXtion
from tests.support.waiting import eventually


def look(camera: VirtualXtion, *words: str) -> list[dict[str, Any]]:
    """Run :mod:`tests.support.virtual_camera.viewer_program` to its end; raises where it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.virtual_camera.viewer_program", *words],
        env={**os.environ, **camera.environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


class Onlooker:
    """Reads frames until it is asked to end; a context manager."""

    def __init__(self, camera: VirtualXtion, *words: str, seconds: float = 60.0) -> None:
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "tests.support.virtual_camera.viewer_program",
                "frames",
                str(seconds),
                "until-eof",
                *words,
            ],
            env={**os.environ, **camera.environment},
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.said: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._camera = camera

    def __enter__(self) -> Self:
        self._camera.await_streaming()
        return self

    def __exit__(self, *_failure: object) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join(PATIENCE_S)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said.append(json.loads(line))

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    @property
    def frames(self) -> list[dict[str, Any]]:
        return [one for one in self.said if "device_index" in one]

    def until(self, condition, what: str = "that") -> None:
        """Wait for something to have been said; fails instead of waiting for ever."""
        eventually(condition, within_s=PATIENCE_S, detail=lambda: f"{what} did not come: {self.said[-3:]}")

    def until_frame(self, index: int) -> None:
        """Wait until a frame with this number, or a later one, was read."""
        self.until(lambda: self.frames and self.frames[-1]["device_index"] >= index, f"frame {index}")

    def end(self) -> list[dict[str, Any]]:
        """Let it close its camera, and return all it has said."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self.until(lambda: not self.is_alive, "an end")
        self._reader.join(PATIENCE_S)
        return self.said
