"""A controller that follows a transcript: what the client must send, and what it is answered.

A transcript is written in a test, or read from an archive of `brushloop doctor --report`.
"""

from __future__ import annotations

import asyncio
import json
import zipfile
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from brushloop.drivers.arcs.wire import BareDecoder, FrameDecoder, Framing, encode, encode_bare_request, encode_request

Answer = Callable[[str, asyncio.StreamWriter], Awaitable[None]]
Line = tuple[str, dict[str, Any] | None, Answer]


def reply(ident: object, **body: object) -> bytes:
    return encode(json.dumps({"id": ident, "jsonrpc": "2.0", **body}).encode())


def result(value: object) -> Answer:
    return sends(lambda ident: reply(ident, result=value))


def sends(make: Callable[[str], bytes], after_s: float = 0.0) -> Answer:
    async def answer(ident: str, writer: asyncio.StreamWriter) -> None:
        await asyncio.sleep(after_s)
        writer.write(make(ident))

    return answer


async def nothing(_: str, __: asyncio.StreamWriter) -> None:
    pass


async def hang_up(_: str, writer: asyncio.StreamWriter) -> None:
    writer.close()


class Controller:
    """Expects the lines of its script in order, and nothing else."""

    def __init__(self, script: list[Line], framing: Framing) -> None:
        self.framing = framing
        self.script = script
        self.surprises: list[str] = []
        self.ids: list[str] = []
        self.port = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        decoder = FrameDecoder() if self.framing == "sof" else BareDecoder()
        while data := await reader.read(4096):
            for payload in decoder.feed(data):
                if payload.startswith(b"__login__"):
                    writer.write(encode(b"logged in"))
                else:
                    await self._follow(payload, writer)
        writer.close()

    async def _follow(self, payload: bytes, writer: asyncio.StreamWriter) -> None:
        request = json.loads(payload)
        if not self.script:
            self.surprises.append(f"nobody expected {request}")
            return
        method, params, answer = self.script.pop(0)
        expected = (encode_request if self.framing == "sof" else encode_bare_request)(request["id"], method, params)
        if payload != expected:
            self.surprises.append(f"expected {expected!r}, got {payload!r}")
        self.ids.append(request["id"])
        await answer(request["id"], writer)


@asynccontextmanager
async def following(script: list[Line], framing: Framing = "sof") -> AsyncIterator[Controller]:
    """Serve the script on a port of 127.0.0.1; fail where anything else was sent, or anything was left unsent."""
    controller = Controller(script, framing)
    server = await asyncio.start_server(controller.serve, "127.0.0.1", 0)
    controller.port = server.sockets[0].getsockname()[1]
    yield controller
    server.close()
    await server.wait_closed()
    assert not controller.surprises
    assert not controller.script, f"never asked for: {controller.script}"


class Archive:
    """What `brushloop doctor --report` wrote."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self.framing: Framing = json.loads(archive.read("report.json"))["framing"]
            self.lines = [json.loads(line) for line in archive.read("arcs.jsonl").splitlines()]

    def script(self) -> list[Line]:
        """Its lines as a test writes them."""
        return [(line["method"], line["params"], self._answer(line["answer"])) for line in self.lines]

    def _answer(self, answer: dict[str, Any]) -> Answer:
        if "silence" in answer:
            return nothing
        if "lost" in answer:
            return hang_up
        body = {key: value for key, value in answer.items() if key in ("result", "error")}  # of `refused`: neither
        framed = encode if self.framing == "sof" else bytes
        return sends(lambda ident: framed(json.dumps({"id": ident, "jsonrpc": "2.0", **body}).encode()))
