"""What the front server adds to viser's stream of poses: latency, processor time, time to load a scene."""

from __future__ import annotations

import asyncio
import multiprocessing
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from statistics import median, quantiles
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import zstandard
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from studio.server import FrontServer, make_app, start_viser

if TYPE_CHECKING:
    import viser

BODIES = 12  # that move: the links of two arms
POSE_RATE = 30.0  # [Hz]
SCENE = 3_000_000  # [bytes], the most that our scene may have
CLIENTS = (1, 4)
PROTOCOL = Subprotocol(f"viser-v{version('viser')}")


def measure(seconds: float = 5.0) -> dict[str, float]:
    """With 1 and with 4 viewers, straight to viser and through the front server.

    Latency is from viser's encoder to the viewer, who lives in another process.
    """
    found: dict[str, float] = {}
    server = start_viser()
    with (
        FrontServer(make_app(server.get_port()), port=0) as front,
        _moving(server),
        ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as viewers,
    ):
        viewers.submit(_watch, front.port, 1, 0.1).result()  # imports, and warms up
        for n in CLIENTS:
            for way, port in {"direct": server.get_port(), "proxied": front.port}.items():
                begin = _front_cpu()
                loads, latencies = viewers.submit(_watch, port, n, seconds).result()
                found |= {
                    f"{way}_{n}_load_ms": max(loads) * 1e3,
                    f"{way}_{n}_messages_per_s": len(latencies) / n / seconds,
                    f"{way}_{n}_p50_ms": median(latencies) * 1e3,
                    f"{way}_{n}_p99_ms": quantiles(latencies, n=100)[-1] * 1e3,
                    f"{way}_{n}_front_cpu": (_front_cpu() - begin) / (seconds + max(loads)),  # of a core
                }
    server.stop()
    return found


@contextmanager
def _moving(server: viser.ViserServer) -> Iterator[None]:
    """A scene of full size, whose bodies move."""
    rng = np.random.default_rng(0)
    server.scene.add_mesh_simple(
        "/mesh", rng.normal(size=(SCENE // 12, 3)).astype(np.float32), np.zeros((1, 3), np.uint32)
    )
    bodies = [server.scene.add_frame(f"/body{n}") for n in range(BODIES)]
    stopped = threading.Event()

    def move() -> None:
        while not stopped.wait(1 / POSE_RATE):
            with server.atomic():
                for body in bodies:
                    body.position, body.wxyz = rng.normal(size=3), rng.normal(size=4)
            server.flush()

    thread = threading.Thread(target=move)
    thread.start()
    yield
    stopped.set()
    thread.join()


def _front_cpu() -> float:
    """[s] of processor time that the front server's thread has used."""
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "front server")
    assert thread.ident
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def _watch(port: int, n: int, seconds: float) -> tuple[list[float], list[float]]:
    """Of n viewers: the time each took to load the scene, and all messages' latencies after it [s]."""

    async def all_viewers() -> list[tuple[float, list[float]]]:
        return await asyncio.gather(*(_view(port, seconds) for _ in range(n)))

    loads, latencies = zip(*asyncio.run(all_viewers()), strict=True)
    return list(loads), [latency for each in latencies for latency in each]


async def _view(port: int, seconds: float) -> tuple[float, list[float]]:
    begin = time.monotonic()
    url = f"ws://127.0.0.1:{port}/"
    async with connect(url, subprotocols=[PROTOCOL], compression=None, max_size=None, proxy=None) as server:
        loaded, latencies = 0.0, []
        while not loaded or time.monotonic() < begin + loaded + seconds:
            message = await server.recv(decode=False)
            arrived = time.perf_counter()  # the clock that viser reads, the same in all processes on Linux
            content = _decode(message)
            if loaded:
                latencies.append(arrived - content["timestampSec"])
            elif any(each["type"] == "ReplayDoneMessage" for each in content["messages"]):
                loaded = time.monotonic() - begin
        return loaded, latencies


def _decode(message: bytes) -> dict[str, Any]:
    """One window of viser's messages: two sizes, compressed msgpack, raw arrays."""
    size = int.from_bytes(message[8:16], "little")
    return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(message[16 : 16 + size]))  # type: ignore[no-any-return]
