"""How a program that makes load is spoken to: a line of JSON says what to do, then lines tell it to begin and to end.

It runs with little priority: it must not take the cores from what is measured.
"""

import asyncio
import json
import os
import resource
import ssl
import sys
from collections.abc import Awaitable, Callable

NICENESS = 10
Work = Callable[[dict[str, object], asyncio.StreamReader], Awaitable[dict[str, object]]]
"""Does what is asked, says ``ready``, reads the lines ``begin`` and ``end``, and returns what it counted between."""


def trusted_by(asked: dict[str, object]) -> ssl.SSLContext | None:
    """Return what the service's certificate is verified with; None where it speaks plain HTTP."""
    certificate = asked.get("certificate")
    return None if certificate is None else ssl.create_default_context(cafile=str(certificate))


def say(line: str) -> None:
    """Write a line to the parent process."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def processor_s() -> float:
    """Return what this program has used of the cores [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def work_as_asked(work: Work) -> None:
    """Be such a program, from its first line to its result."""
    os.nice(NICENESS)
    asyncio.run(_listen(work))


async def _listen(work: Work) -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    asked = json.loads(await reader.readline())
    say(json.dumps(await work(asked, reader)))
