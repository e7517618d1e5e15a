"""A policy in a process of its own, here or on another machine, behind one authenticated WebSocket.

The server loads the network, the client asks it: `RemotePolicy` is a `policy.agent.Policy` whose `predict`
waits for the answer. What travels is msgpack, decoded into the types below and nothing else. Over a network
use a tunnel (ssh -L): the token keeps strangers out, the link itself is not encrypted.
"""

from __future__ import annotations

import hmac
import http
import math
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import websockets.exceptions
from websockets.http11 import Request, Response
from websockets.sync.client import connect
from websockets.sync.server import Server, ServerConnection, serve

from controller.types import Array
from policy.agent import ActionChunk, ArmChunk, Inputs, Policy, PolicySpec, load_policy

TOKEN = "STUDIO_POLICY_TOKEN"  # environment variable of the shared secret
MAX_MESSAGE = 64 << 20  # [bytes] three cameras of 480 x 640 are 2.8 MB
ANSWER_TIMEOUT = 30.0  # [s] after which a network is given up
START_TIMEOUT = 120.0  # [s] for Python, torch and the weights on a busy machine
ANSWERS_AT = "Answers at "  # what a server prints before its address


class Packed(msgspec.Struct, frozen=True, array_like=True):
    """An array."""

    dtype: Literal["<f8", "|u1"]
    shape: tuple[int, ...]
    data: bytes


class Hello(msgspec.Struct, frozen=True, tag=True):
    """What the server says first."""

    spec: PolicySpec


class Begin(msgspec.Struct, frozen=True, tag=True):
    """A run begins."""

    seed: int


class Question(msgspec.Struct, frozen=True, tag=True):
    """`Inputs`."""

    time: float
    arrays: dict[str, Packed]
    images: dict[str, Packed]


class Answer(msgspec.Struct, frozen=True, tag=True):
    """An `ActionChunk`: of each arm the fields of `ArmChunk` that are there."""

    time: float
    period: float
    arms: tuple[dict[str, Packed], ...]


class Sorry(msgspec.Struct, frozen=True, tag=True):
    """Why there is no answer."""

    why: str


_encode = msgspec.msgpack.Encoder().encode
_to_server = msgspec.msgpack.Decoder(Begin | Question)
_to_client = msgspec.msgpack.Decoder(Hello | Answer | Sorry)


class RemotePolicy:
    """The client: a policy that another process runs. Not for two threads at once."""

    def __init__(self, address: str, token: str, *, on_close: Callable[[], None] = lambda: None) -> None:
        """Connect to ws://HOST:PORT. Raises ConnectionError with what is wrong."""
        self._on_close = on_close
        try:
            self._link = connect(
                address,
                additional_headers={"Authorization": f"Bearer {token}"},
                max_size=MAX_MESSAGE,
                compression=None,
                proxy=None,
            )
        except websockets.exceptions.InvalidStatus as error:
            raise ConnectionError(
                f"{address} refuses us ({error}); is {TOKEN} the server's token?"
            ) from error
        except (OSError, websockets.exceptions.WebSocketException) as error:
            raise ConnectionError(f"No policy answers at {address}: {error}") from error
        try:
            hello = self._receive()
        except msgspec.DecodeError as error:
            self._link.close()
            raise ConnectionError(f"{address} speaks another version of the studio: {error}") from error
        assert isinstance(hello, Hello)
        self.spec = hello.spec

    def reset(self, seed: int) -> None:
        self._send(Begin(seed))

    def predict(self, inputs: Inputs) -> ActionChunk:
        """Ask and wait. Raises ConnectionError where the server has gone, ValueError with what it refuses."""
        self._send(_question(inputs))
        answer = self._receive()
        if isinstance(answer, Sorry):
            raise ValueError(answer.why)
        assert isinstance(answer, Answer)
        return _chunk(answer)

    def close(self) -> None:
        self._link.close()
        self._on_close()

    def _send(self, message: msgspec.Struct) -> None:
        try:
            self._link.send(_encode(message))
        except websockets.exceptions.ConnectionClosed as error:
            raise ConnectionError(f"The policy has hung up: {error}") from error

    def _receive(self) -> Hello | Answer | Sorry:
        try:
            said: Hello | Answer | Sorry = _to_client.decode(_bytes(self._link.recv(ANSWER_TIMEOUT)))
            return said
        except TimeoutError:
            raise ConnectionError(f"The policy gave no answer for {ANSWER_TIMEOUT:.0f} s.") from None
        except websockets.exceptions.ConnectionClosed as error:
            raise ConnectionError(f"The policy has hung up: {error}") from error


class PolicyServer:
    """Lets clients ask a policy, one at a time. Use it in a `with`."""

    def __init__(self, policy: Policy, token: str, host: str = "127.0.0.1", port: int = 0) -> None:
        """Port 0 takes a free one."""
        self._policy, self._token = policy, token.encode()
        self._asking = threading.Lock()
        self.left = threading.Event()  # a client has been here and gone
        self._links: set[ServerConnection] = set()
        self._server: Server = serve(
            self._answer,
            host,
            port,
            process_request=self._check,
            max_size=MAX_MESSAGE,
            compression=None,
        )
        self.address = f"ws://{host}:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="policy server", daemon=True)
        self._thread.start()

    def __enter__(self) -> PolicyServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        for link in list(self._links):
            link.close()

    def _check(self, connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get("Authorization", "").removeprefix("Bearer ").encode()
        if hmac.compare_digest(given, self._token):
            return None
        return connection.respond(http.HTTPStatus.UNAUTHORIZED, "Wrong token.\n")

    def _answer(self, link: ServerConnection) -> None:
        self._links.add(link)
        try:
            link.send(_encode(Hello(self._policy.spec)))
            for message in link:
                if (answer := self._answer_to(_bytes(message))) is not None:
                    link.send(_encode(answer))
        except websockets.exceptions.ConnectionClosed:
            pass
        finally:
            self._links.discard(link)
            self.left.set()

    def _answer_to(self, message: bytes) -> Answer | Sorry | None:
        try:
            asked = _to_server.decode(message)
            with self._asking:
                if isinstance(asked, Begin):
                    self._policy.reset(asked.seed)
                    return None
                return _answer_of(self._policy.predict(_inputs(asked)))
        except Exception as error:  # a question that the network cannot take must not end the server
            return Sorry(f"{type(error).__name__}: {error}")


def serve_policy(
    run: Path,
    host: str,
    port: int,
    *,
    hide: Sequence[str] = (),
    device: str = "cpu",
    once: bool = False,
    tell: Callable[[str], None] = print,
) -> None:
    """Load the policy of a run or checkpoint and answer until Ctrl-C, or until the first client has left."""
    policy = load_policy(run, device=device, hide_images="images" in hide, hide_wrench="wrench" in hide)
    given = os.environ.get(TOKEN)
    token = given or secrets.token_urlsafe()
    with PolicyServer(policy, token, host, port) as server:
        tell(f"{ANSWERS_AT}{server.address} with {policy.spec.run} after {policy.spec.step} steps.")
        if not given:
            tell(f"{TOKEN}={token}")
        server.left.wait() if once else threading.Event().wait()


def is_address(text: str) -> bool:
    """Whether it is that of a policy server."""
    return text.startswith(("ws://", "wss://"))


def connect_to(address: str) -> RemotePolicy:
    """A policy server whose token is in the environment. Raises ConnectionError where it is not."""
    if not (token := os.environ.get(TOKEN)):
        raise ConnectionError(f"Set {TOKEN} to the token that the policy server at {address} printed.")
    return RemotePolicy(address, token)


def start(run: Path, *, options: Sequence[str] = ()) -> RemotePolicy:
    """Load a run's policy in a process of our own; closing it ends the process.

    Raises RuntimeError with the last words of a process that ends instead.
    """
    token = secrets.token_urlsafe()
    child = subprocess.Popen(
        [sys.executable, "-m", "studio", "policy-server", str(run), "--once", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, TOKEN: token},
    )

    def end() -> None:
        child.kill()
        child.wait()
        if child.stdout:
            child.stdout.close()

    try:
        return RemotePolicy(_address_from(child), token, on_close=end)
    except BaseException:
        end()
        raise


def _address_from(child: subprocess.Popen[str]) -> str:
    """Of a server that starts."""
    assert child.stdout
    given_up = threading.Timer(START_TIMEOUT, child.kill)
    given_up.start()
    said, begun = "it said nothing", time.monotonic()
    try:
        for line in child.stdout:
            if line.startswith(ANSWERS_AT):
                return line.removeprefix(ANSWERS_AT).split()[0]
            said = line.strip() or said
    finally:
        given_up.cancel()
    when = (
        f"was ended after {START_TIMEOUT:.0f} s"
        if time.monotonic() - begun > START_TIMEOUT
        else "ended at once"
    )
    raise RuntimeError(f"The policy process {when}: {said}")


# Between arrays and messages

_INPUTS = ("base_from_tcp", "q", "gripper", "wrench")
_CHUNK = ("gripper", "position", "wxyz", "translational", "rotational", "q")


def _question(inputs: Inputs) -> Question:
    return Question(
        inputs.time,
        {name: _packed(getattr(inputs, name), "<f8") for name in _INPUTS},
        {camera: _packed(image, "|u1") for camera, image in inputs.images.items()},
    )


def _inputs(question: Question) -> Inputs:
    if set(question.arrays) != set(_INPUTS):
        raise ValueError(f"A question holds {sorted(_INPUTS)}, not {sorted(question.arrays)}.")
    arrays: dict[str, Any] = {name: _unpacked(packed) for name, packed in question.arrays.items()}
    return Inputs(
        time=question.time, images={name: _unpacked(p) for name, p in question.images.items()}, **arrays
    )


def _answer_of(chunk: ActionChunk) -> Answer:
    return Answer(
        chunk.time,
        chunk.period,
        tuple(
            {n: _packed(column, "<f8") for n in _CHUNK if (column := getattr(arm, n)) is not None}
            for arm in chunk.arms
        ),
    )


def _chunk(answer: Answer) -> ActionChunk:
    arms = tuple(ArmChunk(**{name: _unpacked(p) for name, p in arm.items()}) for arm in answer.arms)
    return ActionChunk(answer.time, answer.period, arms)


def _packed(array: Array, dtype: Literal["<f8", "|u1"]) -> Packed:
    return Packed(dtype, array.shape, np.ascontiguousarray(array, dtype).tobytes())


def _unpacked(packed: Packed) -> Array:
    if min(packed.shape, default=1) < 0 or len(packed.data) != math.prod(packed.shape) * int(packed.dtype[2]):
        raise ValueError(f"{len(packed.data)} bytes are no {packed.shape} array of {packed.dtype}.")
    return np.frombuffer(packed.data, packed.dtype).reshape(packed.shape)


def _bytes(message: str | bytes) -> bytes:
    return message if isinstance(message, bytes) else message.encode()
