"""Software that calls: a program of its own, ``python -m verification.load.callers``.

(see ``verification.load.program_protocol``).

Requests are sent at fixed moments whatever became of those before, over connections that are kept; a latency counts
from the moment at which the request was due. One client beside them exports the session's samples over and over.
"""

import asyncio
import itertools
import time
from collections import Counter, defaultdict
from collections.abc import Iterator

from verification.load.program_protocol import processor_s, say, trusted_by, work_as_asked

SESSION = "/api/v1/sessions/{id}"
MIX = (
    *(("GET", SESSION),) * 6,
    *(("GET", "/api/v1/sessions"),) * 3,
    *(("GET", f"{SESSION}/picture"),) * 3,
    *(("GET", f"{SESSION}/transitions"),) * 3,
    *(("GET", "/metrics"),) * 2,
    *(("GET", "/readyz"),) * 2,
    ("GET", "/api/v1/interlocks"),
)
"""What is asked in turn, in twentieths."""
HOLD_EVERY = 500
"""The beam is held by hand at every so-manieth request, and released half a second later."""
RELEASED_AFTER = 25
MOST_CONNECTIONS = 64
PATIENCE_S = 30.0


class Callers:
    """Sends the mix, and counts what comes back."""

    def __init__(self, asked: dict[str, object]) -> None:
        self._asked, self._trusted = asked, trusted_by(asked)
        self._idle: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []
        self._open = 0
        self.latencies_ms: defaultdict[str, list[float]] = defaultdict(list)
        self.answers: Counter[str] = Counter()
        self.exports: list[tuple[float, int]] = []
        self.unsent = 0

    def forget(self) -> None:
        """Count anew."""
        self.latencies_ms.clear()
        self.answers.clear()
        self.exports.clear()
        self.unsent = 0

    async def send_the_mix(self, per_s: float) -> None:
        """Send requests at their moments until cancelled."""
        begun_s, waiting = time.monotonic(), set()
        for number, (method, path) in enumerate(self._calls()):
            due_s = begun_s + number / per_s
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            if self._open >= MOST_CONNECTIONS and not self._idle:
                self.unsent += 1
                continue
            task = asyncio.create_task(self._call(method, path, due_s))
            waiting.add(task)
            task.add_done_callback(waiting.discard)

    async def export_over_and_over(self) -> None:
        """Export the samples, again and again, until cancelled."""
        while True:
            began_s = time.monotonic()
            status, size = await self._ask("GET", f"{self._session}/samples?format={self._asked['export']}")
            self.answers[f"export {status}"] += 1
            self.exports.append((time.monotonic() - began_s, size))

    @property
    def _port(self) -> int:
        return int(str(self._asked["port"]))

    @property
    def _session(self) -> str:
        return SESSION.format(id=self._asked["session_id"])

    def _calls(self) -> Iterator[tuple[str, str]]:
        for number, (method, path) in enumerate(itertools.cycle(MIX)):
            if self._asked["is_holding"] and number % HOLD_EVERY in {HOLD_EVERY // 2, HOLD_EVERY // 2 + RELEASED_AFTER}:
                yield "POST", f"{self._session}/{'hold' if number % HOLD_EVERY == HOLD_EVERY // 2 else 'release'}"
            else:
                yield method, path.format(id=self._asked["session_id"])

    async def _call(self, method: str, path: str, due_s: float) -> None:
        name = f"{method} {path.replace(str(self._asked['session_id']), '{id}')}"
        try:
            async with asyncio.timeout(PATIENCE_S):
                status, _ = await self._ask(method, path)
        except (OSError, ValueError, TimeoutError, asyncio.IncompleteReadError) as error:
            self.answers[f"{name} {type(error).__name__}"] += 1
            return
        self.latencies_ms[name].append(1e3 * (time.monotonic() - due_s))
        self.answers[f"{name} {status}"] += 1

    async def _ask(self, method: str, path: str) -> tuple[int, int]:
        """Send one request and read its answer whole; returns the status and the body's size."""
        while self._idle:
            place = self._idle.pop()
            try:
                return await self._ask_over(place, method, path)
            except (ConnectionError, asyncio.IncompleteReadError) as error:
                # The service closes what was idle for seconds; clients open another one then.
                if getattr(error, "partial", b""):
                    raise
        self._open += 1
        return await self._ask_over(
            await asyncio.open_connection("127.0.0.1", self._port, ssl=self._trusted), method, path
        )

    async def _ask_over(
        self, place: tuple[asyncio.StreamReader, asyncio.StreamWriter], method: str, path: str
    ) -> tuple[int, int]:
        reader, writer = place
        is_kept = False
        try:
            body = b"{}" if method == "POST" else b""
            head = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{self._port}"]
            head += [f"Authorization: {self._asked['authorization']}"]
            head += ["Content-Type: application/json", f"Content-Length: {len(body)}"] if body else []
            writer.write("\r\n".join([*head, "", ""]).encode() + body)
            status, size, is_kept = await _read_answer(reader)
        finally:
            if is_kept:
                self._idle.append(place)
            else:
                self._open -= 1
                writer.close()
        return status, size


async def _read_answer(reader: asyncio.StreamReader) -> tuple[int, int, bool]:
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
    status = int(head[0].split(" ", 2)[1])
    fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:])}
    is_kept = fields.get("connection", "").lower() != "close"
    if fields.get("transfer-encoding", "").lower() == "chunked":
        size = 0
        while length := int((await reader.readline()).split(b";")[0], 16):
            await reader.readexactly(length + 2)
            size += length
        await reader.readline()
        return status, size, is_kept
    size = int(fields.get("content-length", "0"))
    await reader.readexactly(size)
    return status, size, is_kept


async def _run(asked: dict[str, object], lines: asyncio.StreamReader) -> dict[str, object]:
    callers = Callers(asked)
    tasks = [asyncio.create_task(callers.send_the_mix(float(str(asked["per_s"]))))] if asked["per_s"] else []
    if asked["export"]:
        tasks.append(asyncio.create_task(callers.export_over_and_over()))
    say("ready")
    await lines.readline()
    callers.forget()
    before_s = processor_s()
    await lines.readline()
    for task in tasks:
        task.cancel()
    ended = await asyncio.gather(*tasks, return_exceptions=True)
    return {
        "latencies_ms": callers.latencies_ms,
        "answers": callers.answers,
        "exports": callers.exports,
        "unsent": callers.unsent,
        "failures": [repr(one) for one in ended if isinstance(one, Exception)],
        "processor_s": processor_s() - before_s,
    }


if __name__ == "__main__":
    work_as_asked(_run)
