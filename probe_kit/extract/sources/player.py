"""Players show the rows of a source, one observation after the other, here or in a process of their own."""

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from hashlib import blake2b
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._execution.array_connection import ArrayConnection
from probe_kit._execution.process_pool import Child
from probe_kit.errors import (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    ProbeKitError,
    RecordingError,
    SceneError,
    StageDiedError,
)
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.input_content import EpisodeFrames
from probe_kit.runs.layout import CAPTURE_ONLY
from probe_kit.runs.plan import Row
from probe_kit.runs.small_frames import SmallFrames

# What one episode can get wrong by itself; everything else is wrong with the whole run and stops it.
EPISODE_ERRORS = (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    RecordingError,
    SceneError,
    StageDiedError,
)


@dataclass(frozen=True)
class Done:
    """The event of an episode that is committed."""

    number: int
    outcome: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """The event of an episode that failed.

    Attributes:
        reason: The reason in words.
        traceback: The traceback of its error; empty if its process died.
    """

    number: int
    reason: str
    traceback: str = ""


Event = Done | Failed

LONGEST_TRACEBACK = 20_000
"""The characters of a traceback that are kept: its end, which names the error."""


def add_traceback(error: BaseException) -> None:
    """Store the traceback of `error` in the error itself, so that it survives being sent to another process."""
    error.__dict__["probe_kit_traceback"] = traceback_of(error)


def traceback_of(error: BaseException) -> str:
    """Return the traceback of `error`, after that of the process it was sent from."""
    local = "".join(traceback.format_exception(error))
    sent: str = error.__dict__.get("probe_kit_traceback", "")
    return (sent + local)[-LONGEST_TRACEBACK:]


SIDE = 32
"""The pixels along a side of the stored pictures."""


@dataclass(frozen=True)
class Ending:
    """The end of an episode.

    Attributes:
        outcome: The record of the episode as flat columns.
        frames: A frame per action if the episode was filmed, else empty.
        small_frames: The small frames of the episode.
        trajectory: (T + 1, C) float32; see `probe_kit.env.scoring`.
        seconds: The wall-clock seconds that the player worked on the episode.
        inputs: (n, …) by kind the inputs that were shown in n inferences, of sources without a scene.
    """

    outcome: dict[str, Any]
    frames: list[NDArray[np.uint8]]
    small_frames: SmallFrames = ()
    trajectory: NDArray[np.float32] | None = None
    seconds: float = 0.0
    inputs: Mapping[str, NDArray[Any]] | None = None


Answer = Observation | Ending


class Player(ABC):
    """A source of observations with its current episode, and the seconds it worked on that."""

    row: Row
    _seconds = 0.0

    @abstractmethod
    def begin(self, row: Row, film: bool) -> Answer:
        """Set an episode up and show its beginning; with `film` every frame is kept."""

    @abstractmethod
    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Execute actions (n, D) until they or the episode end."""

    def dismiss(self) -> Ending:
        """End the episode without an action."""
        raise NotImplementedError

    def close(self) -> None:  # noqa: B027 - most players hold nothing
        """Free what the player holds."""

    def answer(self, method: str, arguments: tuple[Any, ...]) -> Answer:
        """Call `begin`, `advance` or `dismiss`; an ending says how many seconds all calls of its episode took.

        Errors carry a note naming the episode.
        """
        if method == "begin":
            self._seconds, self.row = 0.0, arguments[0]
        started = perf_counter()
        try:
            answer: Answer = getattr(self, method)(*arguments)
        except ProbeKitError as error:
            error.add_note(f"in episode {self.row.episode_id} ({self.row.instruction!r})")
            raise error from None
        self._seconds += perf_counter() - started
        return answer if isinstance(answer, Observation) else replace(answer, seconds=self._seconds)


class ShownInputs:
    """The inputs that were shown in an episode: arrays of every inference, and a hash of pictures."""

    def _clear(self) -> None:
        self._inputs: dict[str, list[NDArray[Any]]] = {}
        self._hash = blake2b(digest_size=16)

    def _keep(self, name: str, values: Any, most: int | None = None) -> None:
        """Keep the values of one inference, unless `most` were kept already."""
        stored = self._inputs.setdefault(name, [])
        if most is None or len(stored) < most:
            stored.append(np.array(values))

    def _keep_pictures(self, pictures: list[NDArray[np.uint8]], stored: bool, most: int | None = None) -> None:
        """Hash the pictures of one inference, and keep them in small if they are stored."""
        for picture in pictures:
            self._hash.update(f"{picture.shape}".encode() + np.ascontiguousarray(picture).tobytes())
        if stored:
            self._keep("pixels", np.stack([small_picture(picture) for picture in pictures]), most)

    def _ending(self, outcome: Mapping[str, Any], small_frames: SmallFrames = ()) -> Ending:
        inputs = {name: np.stack(values) for name, values in self._inputs.items()}
        return Ending({**outcome, "frames_blake2b": self._hash.hexdigest()}, [], small_frames, inputs=inputs)


class InputsPlayer(ShownInputs, Player):
    """A player that keeps what labels and controls are made of."""

    def dismiss(self) -> Ending:
        """End the episode after its first observation: its model was asked."""
        return self._ending({"outcome": CAPTURE_ONLY})


def small_picture(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture (SIDE, SIDE, 3), in which each pixel is the mean of its part of the picture."""
    return np.asarray(Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.BOX))


def frames_of_episode(
    name: str, frames: Sequence[Sequence[NDArray[np.uint8]]], state: NDArray[np.floating] | None = None
) -> EpisodeFrames:
    """Return pictures in small, and the hashes of the whole ones.

    Args:
        name: The episode.
        frames: The pictures (H, W, 3) uint8 of all cameras, at some frames.
        state: (n, D) at these frames; None without one.
    """
    small = np.stack([np.stack([small_picture(picture) for picture in pictures]) for pictures in frames])
    hashes = [
        [blake2b(np.ascontiguousarray(picture).tobytes()).digest() for picture in pictures] for pictures in frames
    ]
    return EpisodeFrames(name, small, state, hashes)


# -- where a player works -------------------------------------------------------------------------------------

Request = tuple[str, tuple[Any, ...]]
"""A method of `Player` and its arguments."""
Opens = Callable[[], Player]
"""A function that opens a player; a child process imports it by its name."""


def request_after(answer: object, then: Request | None) -> Request | None:
    """Return the request that a player starts after an answer: `then` if its episode ended, else None."""
    return then if isinstance(answer, Ending) else None


class LocalPlayer:
    """A player in this process, asked first and answered later: the work is done when the answer is wanted."""

    def __init__(self, opens: Opens) -> None:
        self._player = opens()

    def ask(self, method: str, *arguments: Any, then: Request | None = None) -> None:
        """Start `begin`, `advance` or `dismiss`; `then` starts at once if that ends the episode, and only then.

        The answer to `then` is the next one.
        """
        self._request, self._then = (method, arguments), then

    def answer(self) -> Answer:
        """Return the answer to the last request, or raise its error."""
        answer = self._player.answer(*self._request)
        if (following := request_after(answer, self._then)) is not None:
            self._request, self._then = following, None
        return answer

    def close(self) -> None:
        """Free what the player holds."""
        self._player.close()


_idle: list[Child] | None = None
"""Child processes without a player, for the next ones; None where each player has a process of its own."""


@contextmanager
def reusing_processes() -> Iterator[None]:
    """Let a player in the body take the process of one that was closed before: starting one takes a second.

    Code that the process has imported is not read again, so that the body should be a single command.
    """
    global _idle
    if _idle is not None:
        yield
        return
    _idle = []
    try:
        yield
    finally:
        idle, _idle = _idle, None
        for child in idle:
            child.close()


class ProcessPlayer:
    """A player in a child process, of which several work at a time.

    A child that dies costs its episode and is replaced.
    """

    def __init__(self, opens: Opens) -> None:
        self._opens = opens
        self._start(_idle.pop() if _idle else self._child_process())

    @staticmethod
    def _child_process() -> Child:
        return Child("probe_kit.extract.sources.player:serve")

    def _start(self, child: Child) -> None:
        self._child, self._is_working = child, False
        self._send(self._opens)

    def _send(self, message: Any) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # `answer` finds out and says so
            self._child.connection.send(message)

    def ask(self, method: str, *arguments: Any, then: Request | None = None) -> None:
        """Send the request; the child works while this process continues."""
        self._then, self._is_working = then, True
        self._send(((method, arguments), then))

    def answer(self) -> Answer:
        """Wait for the answer."""
        try:
            answer = self._child.connection.recv()
        except (EOFError, ConnectionResetError):
            code = self._child.close()
            self._start(self._child_process())
            raise StageDiedError(
                f"the process that simulates the episode ended with code {code}; look above for its last words"
            ) from None
        self._is_working = request_after(answer, self._then) is not None
        self._then = None
        if isinstance(answer, ProbeKitError):
            raise answer
        result: Answer = answer
        return result

    def close(self) -> None:
        """End the child, or leave it to the next player; one that still works is ended."""
        if _idle is not None and not self._is_working:
            with suppress(BrokenPipeError, ConnectionResetError):
                self._child.connection.send(None)
                _idle.append(self._child)
                return
        self._child.close()


AskablePlayer = LocalPlayer | ProcessPlayer


def serve(connection: ArrayConnection) -> None:
    """Open one player after the other in the child process and answer its requests, until the parent hangs up."""
    while True:
        opens = connection.recv()
        try:
            player = opens()
        except ProbeKitError as error:
            connection.recv()
            connection.send(error)
            return
        try:
            _serve_player(player, connection)
        finally:
            player.close()


def _serve_player(player: Player, connection: ArrayConnection) -> None:
    """Answer requests up to the one that closes the player."""
    while (message := connection.recv()) is not None:
        request, then = message
        answer = _answer_of_call(player, request)
        connection.send(answer)
        if (following := request_after(answer, then)) is not None:
            connection.send(_answer_of_call(player, following))


def _answer_of_call(player: Player, request: Request) -> Answer | ProbeKitError:
    try:
        return player.answer(*request)
    except ProbeKitError as error:  # what it costs, an episode or the run, is decided by the parent
        add_traceback(error)
        return error
