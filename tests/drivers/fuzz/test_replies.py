"""JSON replies of the controller: whatever it says, a call ends with a result or an error of the tree."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.motion import Messages
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.errors import DeviceError, MotionFailed, RpcError
from tests.drivers.fuzz.inputs import EXAMPLES, LEAST_INPUTS, MANY, mutated, noise, truncated

SAID = [
    b'[{"code":30047,"level":"ERROR","source":"rob1","args":["x"],"timestamp":17}]',
    b'[{"code":1,"timestamp":2},{"code":30048,"timestamp":900000000000},{"code":"30047","timestamp":[]},7,null]',
    b"[]",
]
REPLIES = [
    b'{"id":"a","jsonrpc":"2.0","result":24000}',
    b'{"id":"a","jsonrpc":"2.0","result":[0.25,-0.23,NaN,1e999,{"b":null}]}',
    b'{"error":{"code":-32601,"message":"method not found"},"id":"a","jsonrpc":"2.0"}',
]
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(10**400)
MESSAGE = st.fixed_dictionaries({}, optional={"code": SCALARS, "timestamp": SCALARS, "level": SCALARS})
ANSWERS = st.one_of(SCALARS, st.lists(MESSAGE | SCALARS, max_size=4), MESSAGE, st.lists(SCALARS, max_size=6))


class Cabinet(Controller):
    """Answers each question with the next of its answers."""

    def __init__(self) -> None:
        super().__init__(RpcConnection("127.0.0.1", 1))
        self.answer: Any = None

    async def ask(self, method: str, **params: object) -> Any:
        return self.answer


async def explained(answer: Any) -> bool:
    """Whether the newest messages explain a failure, asked twice: the second time nothing is new."""
    cabinet = Cabinet()
    messages, failure = Messages(cabinet), MotionFailed("robot", "moveLine", "rests elsewhere")
    cabinet.answer = answer
    first = await messages.explain(failure)
    assert isinstance(first, MotionFailed)
    assert await messages.explain(failure) is failure, "old messages are about old motion"
    return first is not failure


def test_any_messages_explain_a_failure_or_nothing():
    inputs = out_of_reach = 0

    @settings(EXAMPLES, max_examples=300)
    @given(st.lists(ANSWERS, min_size=20, max_size=30))
    def anything(answers: list[Any]) -> None:
        nonlocal inputs
        for answer in answers:
            run(explained(answer))
            inputs += 1

    with asyncio.Runner() as runner:
        run = runner.run
        anything()
        for said in mutated(SAID, 50_000, seed=11):
            try:
                answer = json.loads(said)
            except ValueError:
                continue
            out_of_reach += run(explained(answer))
            inputs += 1
    assert inputs >= LEAST_INPUTS
    assert out_of_reach > 100


def delivered(payload: bytes) -> object:
    """What a call gets for this payload: its result, an error of the tree, or None where it waits on."""
    connection = RpcConnection("127.0.0.1", 1)
    future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    connection._pending = ("a", "getTcpPose", future)
    connection._deliver(payload)
    if not future.done():
        return None
    error = future.exception()
    assert error is None or isinstance(error, DeviceError)
    return error or future


async def test_any_payload_ends_a_call_well_or_leaves_it_waiting():
    inputs = answered = refused = 0

    @EXAMPLES
    @given(MANY)
    def anything(payloads: list[bytes]) -> None:
        nonlocal inputs
        for payload in payloads:
            for begun in (payload, b'{"id":"a","result":' + payload, b'{"id":"a","error":' + payload + b"}"):
                delivered(begun)
                inputs += 1

    anything()
    deep = [b'{"id":"a","error":' + b"[" * depth + b"]" * depth + b"}" for depth in range(10, 2000, 50)]
    for payload in [*truncated(REPLIES), *mutated(REPLIES, 8000, seed=12), *noise(500, seed=13), *deep]:
        outcome = delivered(payload)
        inputs += 1
        refused += isinstance(outcome, RpcError)
        answered += isinstance(outcome, asyncio.Future)
    assert inputs >= LEAST_INPUTS
    assert answered > 100
    assert refused > 50
