"""Archives of `brushloop doctor --report`, and a controller that says again what the one in an archive said."""

from __future__ import annotations

import asyncio
import json
import zipfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from brushloop.drivers.arcs.wire import Decoder, Framing, encode, encode_bare_request, encode_request
from brushloop.drivers.sim.rig import HOST


class Archive:
    """What `brushloop doctor --report` wrote."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self.framing: Framing = json.loads(archive.read("report.json"))["framing"]
            self.lines: list[dict[str, Any]] = [json.loads(line) for line in archive.read("arcs.jsonl").splitlines()]
            """Each has method, params and answer."""

    @asynccontextmanager
    async def replayed(self) -> AsyncIterator[int]:
        """Serve the exchanges on a port; fail where anything else was sent, or anything was left unsent."""
        left, surprises = list(self.lines), list[str]()
        sof = self.framing == "sof"

        def respond(payload: bytes, writer: asyncio.StreamWriter) -> None:
            request = json.loads(payload)
            if not left:
                surprises.append(f"nobody expected {request}")
                return
            line = left.pop(0)
            ident, answer = request["id"], line["answer"]
            expected = (encode_request if sof else encode_bare_request)(ident, line["method"], line["params"])
            if payload != expected:
                surprises.append(f"expected {expected!r}, got {payload!r}")
            body = {key: value for key, value in answer.items() if key in ("result", "error")}  # of `refused`: neither
            reply = json.dumps({"id": ident, "jsonrpc": "2.0", **body}).encode()
            if "lost" in answer:
                writer.close()
            elif "silence" not in answer:
                writer.write(encode(reply) if sof else reply)

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            decoder = Decoder()
            while data := await reader.read(4096):
                for payload in decoder.feed(data):
                    if payload.startswith(b"__login__"):
                        writer.write(encode(b"logged in"))
                    else:
                        respond(payload, writer)
            writer.close()

        async with await asyncio.start_server(serve, HOST, 0) as server:
            yield server.sockets[0].getsockname()[1]
        assert not surprises
        assert not left, f"never asked for: {left}"
