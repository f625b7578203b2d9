"""Settings and observations of small served sessions."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from probe_kit.extract import ExtractSettings
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.serve.server import Server

WORDS = "put the cube on the red shape"
Opens = Callable[..., Server]


def settings(**choices: Any) -> ExtractSettings:
    served = ServedSettings.model_fields.keys()
    source: dict[str, Any] = {
        "cameras": {"base": "observation/image"}, "state": "observation/state", "source_name": "noise@1",
        **{name: value for name, value in choices.items() if name in served},
    }  # fmt: skip
    other_choices = {name: value for name, value in choices.items() if name not in served}
    return ExtractSettings("pi0-tiny", source=ServedSettings(**source), **{"captured_calls": 2, **other_choices})


def observation(number: int, side: int = 48, words: str | None = WORDS) -> dict[str, Any]:
    """An observation of noise as LIBERO's client builds it: float64 state near that of training."""
    rng = np.random.default_rng(number)
    usual, spread = np.array([0.39, 0.02, 0.08, 0, 0.05, 0, 0, 0.64]), np.array([0.03, 0.1, 0.03, 0, 0, 0, 0, 0.1])
    sent: dict[str, Any] = {
        "observation/image": rng.integers(0, 256, (side, side, 3), np.uint8),
        "observation/wrist_image": rng.integers(0, 256, (side, side, 3), np.uint8),
        "observation/state": usual + spread * rng.normal(size=8),
    }
    return sent if words is None else {**sent, "prompt": words}


@contextmanager
def serving(server: Server, stop_after: int | None = None) -> Iterator[str]:
    """Serve on a thread until the body ends."""
    ready = threading.Event()
    loops: list[asyncio.AbstractEventLoop] = []

    def began() -> None:
        loops.append(asyncio.get_running_loop())
        ready.set()

    thread = threading.Thread(target=server.serve, args=(stop_after, began, lambda _: None))
    thread.start()
    assert ready.wait(20)
    try:
        yield server.address
    finally:
        if stop_after is None:
            loops[0].call_soon_threadsafe(server.stop.set)
        thread.join(30)
    assert not thread.is_alive()
