"""The wire of vla-eval, through that harness's own library: it says its episodes, and each step crosses the wire.

A client begins an episode with its task, and sends an observation per step. The chunk stays at the server, which
sends its first actions one by one: so it is known which action was sent at which step.
"""

import logging
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from numbers import Real
from time import monotonic
from typing import Any, ClassVar

import numpy as np
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from probe_kit._system.imports import require
from probe_kit.errors import ObservationError, ProbeKitError
from probe_kit.serve.codec import MessageError, check_bounds
from probe_kit.serve.marks import MOST_FACTS, SUCCESS, Facts, Mark, plain_name, read_facts
from probe_kit.serve.session import Client
from probe_kit.serve.wire import BAD_DATA, WireServer, one_line, text_of

EXTRA = "vla-eval"
PACKAGE = "vla_eval"
TASK, SUITE, EVALUATION = "task", "suite", "eid"
"""The columns of an episode as the harness says them: task and suite, and the id by which its results name it."""
_PREDICTING, _SERVING = f"{PACKAGE}.model_servers.predict", f"{PACKAGE}.model_servers.serve"
_OUTSIDE = (
    "the observation belongs to no episode that began on this connection: the server was started anew in the "
    "middle of it, or it ended. It is not answered; the next episode will be"
)


@dataclass
class VlaEvalServer(WireServer):
    """A server of vla-eval's wire, of one session.

    Attributes:
        execute: The number of actions of each chunk that are sent.
        left_out: Metrics that are no columns, each of which is said once.
    """

    execute: int = 1
    left_out: set[str] = field(default_factory=set)
    keep_alive: ClassVar[float | None] = None  # as the harness: a client may hold its thread for minutes

    async def _converse(self, connection: ServerConnection, client: Client) -> None:
        """Let the harness's own library answer a client, whose messages are read within bounds first."""
        logging.getLogger(PACKAGE).setLevel(logging.CRITICAL)  # its tracebacks are of refused observations
        episodes = Episodes(self, client)
        served = require(_SERVING, EXTRA)._handle_connection
        await served(Bounded(connection, self), _class()(episodes))


@dataclass
class Bounded:
    """A connection whose messages are checked before the harness's library decodes them.

    Attributes:
        connection: The connection.
        server: The server, which may be ending.
    """

    connection: ServerConnection
    server: VlaEvalServer

    async def __aiter__(self) -> AsyncIterator[bytes]:
        """Yield messages within the bounds; another one closes the connection."""
        async for message in self.connection:
            if self.server.ends:
                return
            try:
                if isinstance(message, str):
                    raise MessageError("the message is a text; expected a binary frame of msgpack")
                check_bounds(message)
            except MessageError as error:
                await self.connection.close(BAD_DATA, one_line(error)[:120])
                return
            yield message

    async def send(self, message: bytes) -> None:
        """Send a message."""
        await self.connection.send(message)


@dataclass
class Episodes:
    """The episodes of one connection, as the harness says them.

    Attributes:
        mark: The statement on the episode that was begun; None outside of one.
        refusal: Why the episode that was begun cannot be played; empty for one that can.
    """

    server: VlaEvalServer
    client: Client
    mark: Mark | None = None
    refusal: str = _OUTSIDE
    context: Any = field(default=None, repr=False)

    def begin(self, message: Mapping[str, Any], context: Any) -> None:
        """Begin an episode. What is wrong with it is said with its first observation: a start has no answer."""
        self.context = context
        try:
            self.mark, self.refusal = read_start(message), ""
        except ProbeKitError as error:
            self.mark, self.refusal = None, text_of(error)

    def infer(self, sent: dict[str, Any], step: int, arrived: float) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Return the actions (chunk, D) for an observation, on the thread of the model."""
        assert self.mark is not None, "it is refused before"
        mark = Mark(self.mark.id, self.mark.group, step, columns=self.mark.columns)
        return self.server.session.answer(self.client, sent, mark, arrived)

    def finish(self, message: Mapping[str, Any], steps: int) -> None:
        """End an episode with its metrics, on the thread of the model."""
        mark, self.mark, self.refusal = self.mark, None, _OUTSIDE
        if mark is None:
            return
        facts, left_out = read_metrics(message.get("metrics"))
        if news := [name for name in left_out if name not in self.server.left_out]:
            self.server.note(f"{mark.id}: metrics that are no finite numbers are left out: {', '.join(news)}")
            self.server.left_out.update(news)
        self.server.session.end(self.client, Mark(end=True, facts=facts), steps)


@cache
def _class() -> Any:
    """Return the class of model servers, which extends one of the harness's library."""
    base: Any = require(_PREDICTING, EXTRA).PredictModelServer

    class CapturingServer(base):  # type: ignore[misc]
        """A model server of one connection, which asks the session."""

        def __init__(self, episodes: Episodes) -> None:
            super().__init__(chunk_size=episodes.server.execute)
            self._episodes, self._server = episodes, episodes.server

        def get_observation_params(self) -> dict[str, Any]:
            """Ask a benchmark that has the choice for what the policy reads."""
            source = self._server.session.source
            return {
                **({"send_state": True} if source.settings.state else {}),
                **({"send_wrist_image": True} if len(source.settings.cameras) > 1 else {}),
            }

        async def on_episode_start(self, config: dict[str, Any], ctx: Any) -> None:
            """Remember what the harness says of the episode; its row begins with its first inference."""
            await super().on_episode_start(config, ctx)
            await self._server.on_model_thread(self._server.session.abandon, self._episodes.client)
            self._episodes.begin(config, ctx)

        async def on_observation(self, obs: dict[str, Any], ctx: Any) -> None:
            """Send the next action of the chunk, or the first of a new one. Raises what the client gets."""
            server, episodes = self._server, self._episodes
            server.busy += 1
            try:
                if episodes.refusal or ctx is not episodes.context:
                    server.session.refused += 1
                    raise ObservationError(episodes.refusal or _OUTSIDE)
                await super().on_observation(obs, ctx)
            except ConnectionClosed:
                raise
            except ProbeKitError as error:
                raise type(error)(text_of(error)) from None
            except Exception as error:
                raise RuntimeError(text_of(error)) from error
            finally:
                server.busy -= 1
                server.stop_if_fatal()
            await server.finish_check()

        def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
            """Return a chunk; called on a thread of the library, while the model's own thread infers."""
            arrived, thread = monotonic(), self._server.thread
            return {"actions": thread.submit(self._episodes.infer, obs, ctx.step, arrived).result()}

        async def on_episode_end(self, result: dict[str, Any], ctx: Any) -> None:
            """End the episode with its metrics; without any, the connection ended, which the session knows."""
            await super().on_episode_end(result, ctx)
            if "metrics" in result and ctx is self._episodes.context:
                await self._server.on_model_thread(self._episodes.finish, result, ctx.step)

    # The library sets it on a plain GET of anyone; more than one would ask for a batch, and change numbers.
    CapturingServer.max_batch_size = property(lambda _: 1, lambda *_: None)
    return CapturingServer


def read_start(message: Mapping[str, Any]) -> Mark:
    """Return what a start says of its episode: the id is task and number, the group is the task.

    Raises:
        ObservationError: For a start without the name of a task or the number of the episode.
    """
    task = message.get("task")
    task = task if isinstance(task, Mapping) else {}
    name, number = task.get("name"), task.get("episode_idx")
    if not isinstance(name, str) or not isinstance(number, int) or isinstance(number, bool):
        raise ObservationError(
            f"the start of the episode names the task {name!r:.80} and the episode_idx {number!r:.80}; expected a "
            "text and a number"
        )
    recording = message.get("recording")
    columns = {
        TASK: plain_name(name, "name of the task"),
        SUITE: _plain(task.get("suite")),
        EVALUATION: _plain(recording.get("eid") if isinstance(recording, Mapping) else None),
    }
    return Mark(plain_name(f"{name}/{number}", "id"), columns[TASK], columns=columns)


def _plain(value: Any) -> str:
    return "" if value is None or value == "" else plain_name(value, "text")


def read_metrics(metrics: Any) -> tuple[Facts, list[str]]:
    """Return the numbers and truth values among metrics, and the names of those that are left out.

    `success` is a truth value, as the harness counts it.
    """
    facts: dict[str, float | bool] = {}
    left_out = list[str]()
    for name, value in (metrics if isinstance(metrics, Mapping) else {}).items():
        plain = value.item() if isinstance(value, np.generic) else value
        if name == SUCCESS and isinstance(plain, Real):
            plain = bool(plain)
        try:
            if len(facts) >= MOST_FACTS or not isinstance(plain, Real):
                raise ObservationError("no number")
            facts |= read_facts({name: plain})
        except ObservationError:
            left_out.append(repr(name)[:80])
    return facts, left_out
