"""Observations that clients send: how they become those of a model, what is kept of an episode, and its replay."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit.errors import CheckpointError, ObservationError, UsageError
from probe_kit.extract.sources.player import (
    SIDE,
    Answer,
    Ending,
    InputsPlayer,
    Opens,
    ShownInputs,
    small_picture,
)
from probe_kit.extract.sources.recording import EVERY_CAMERA, Pairs, degrees_of
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.extract.sources.source import Played, Source, check_units, compare_states
from probe_kit.extract.sources.units import Units
from probe_kit.hooks.capturing.edits import Edit, Vectors
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation
from probe_kit.runs.arrays import PICTURE_OF
from probe_kit.runs.layout import CONDITION, DATASET, OTHER_ACTIONS, RECORDED_EPISODES, source_settings_of
from probe_kit.runs.plan import Row
from probe_kit.runs.run import Run, read_run
from probe_kit.runs.store import locate

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.hooks.contract.card import DeclaredInputs

LONGEST_WORDS = 1 << 16
MOST_SIDE = 8192
"""The most pixels along a side of a picture."""
MOST_NUMBERS = 65_536
"""The most numbers of a state."""
_BLANK = (224, 224, 3)
"""The shape of a picture before any was received; the pictures of the usual clients have it."""
NUMBER_KINDS = "biuf"
"""The kinds of arrays that hold numbers."""
UNKNOWN_ACTIONS = "a policy server does not see which actions were executed"


@dataclass(frozen=True)
class Received:
    """An observation as a client sent it, checked and mapped.

    Attributes:
        observation: The observation of the model.
        pictures: (H, W, 3) uint8 by camera of the model, as received: before they are rotated.
        keys: Pairs of a camera of the model and the key of its picture.
    """

    observation: Observation
    pictures: Mapping[str, NDArray[np.uint8]]
    keys: Pairs


class ServedSource(Source[ServedSettings]):
    """The observations of a session, which arrive, or those that a run stores.

    Attributes:
        cameras: Pairs of a camera of the model and a key; empty before the first observation where none was typed.
        shapes: The shape per inference of each stored kind; empty before the first observation of a new run.
        read: The keys that were read so far.
        prediction: The shape (chunk, D) of an answer; (0, 0) before the first one.
    """

    executes = False
    groups = "groups of served episodes"

    def __init__(self, settings: ServedSettings, run: Run | None = None) -> None:
        """Serve, or show the observations of a run again."""
        self.settings, self.run = settings, run
        self.cameras: Pairs = settings.cameras
        self.pictures: dict[str, tuple[int, ...]] = {}
        self.state_size: int | None = None
        self.prediction: tuple[int, ...] = (0, 0)
        self.words: list[str] = [] if settings.instruction is None else [settings.instruction]
        self.model_cameras: tuple[str, ...] = ()
        self._needed_state: int | None = None

    @classmethod
    def open(cls, settings: ServedSettings, selects_only: bool) -> Self:
        """Open the run whose observations are shown again, if the settings name one.

        Raises:
            UsageError: For a run that keeps small pictures alone.
        """
        del selects_only
        if settings.run is None:
            return cls(settings)
        run = read_run(locate(settings.run))
        stored = source_settings_of(run.settings)
        opened = cls(settings.changed(cameras=tuple((name, key) for name, key, _ in stored["cameras"])), run)
        if settings.keep == "small":
            raise UsageError(
                f"{run.location} was served with --keep small: it has pictures at {SIDE} × {SIDE} alone, and they "
                "cannot be shown to its model again. Serve with --keep full"
            )
        return opened

    def decided(self) -> Mapping[str, Any]:
        """Return the settings of a model that acts elsewhere."""
        return {"capture_only": True, "frames": "none"}

    @property
    def name(self) -> str:
        """The name of what is served."""
        return self.settings.name

    @property
    def instructions(self) -> tuple[str, ...]:
        """The instructions that were received so far; those of the run's rows where it is shown again."""
        rows = () if self.run is None else self.rows(0)
        return tuple(dict.fromkeys((*self.words, *(row.instruction for row in rows))))

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return the rows of the run, each with the inferences that are stored; none of a server."""
        del seed
        if self.run is None:
            return ()
        commits = self.run.commits()
        plan = self.run.root.planned
        return tuple(
            Row(
                commit.episode,
                {name: value for name, value in plan[commit.episode].items() if name != "episode"},
                frames=() if self._is_edited(commit.episode) else tuple(commit.control_steps[: len(commit.roles)]),
                noise=tuple(number * self.settings.every for number in range(len(commit.roles))),
            )
            for commit in commits
        )

    def edits_by_condition(self) -> Mapping[str, tuple[Sequence[Edit], Vectors]]:
        """Return the edits of the conditions, with their vectors; empty without conditions."""
        return {condition.name: (condition.edits, condition.vectors) for condition in self.settings.conditions}

    def _is_edited(self, number: int) -> bool:
        """Whether the streams of an episode were edited: its predictions are not those of the model as it is."""
        assert self.run is not None, "a stored run has episodes"
        name = self.run.root.planned[number].get(CONDITION)
        return any(condition.edits for condition in self.settings.conditions if condition.name == name)

    # -- a model -------------------------------------------------------------------------------------

    def early_checks(self, inputs: "DeclaredInputs", checkpoint: str) -> list[Callable[[], object]]:
        """Return checks of typed cameras and of the state."""
        return [lambda: self.check_cameras(inputs.cameras), lambda: self._check_state(inputs.state, checkpoint)]

    def _check_state(self, numbers: int | None, checkpoint: str) -> None:
        """Raise UsageError for a policy that reads a state of which no key is given; None reads none."""
        if numbers is not None and not self.settings.state:
            raise UsageError(
                f"{checkpoint} reads a state of {numbers} numbers, and no key of it is given. Name it, such as "
                "--state observation/state"
            )

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Fit typed cameras and the state to a policy. What a client sends is checked as it arrives.

        Raises:
            UsageError: For a camera that the model lacks, a state that is not named, averaged chunks, and edits
                that do not fit.
            CheckpointError: For a policy whose predictions are no actions.
        """
        del accept_units
        card = policy.card
        if policy.predicts_relative:
            raise CheckpointError(
                f"{card.checkpoint} predicts changes relative to the state (use_relative_actions), and nothing "
                "adds the state. Take a checkpoint that predicts actions"
            )
        if card.ensemble is not None:
            raise UsageError(
                f"{card.family} averages overlapping chunks, and a client executes a chunk as it is. Leave that "
                "option out"
            )
        self._check_state(policy.state_numbers, card.checkpoint)
        for condition in self.settings.conditions if self.run is None else ():
            condition.check(policy, card.weights_sha256)
        self._needed_state, self.model_cameras = policy.state_numbers, tuple(card.cameras)
        self.check_cameras(card.cameras)
        return self, self.with_cameras_of(policy) if self.cameras else policy

    def check_cameras(self, cameras: Sequence[str]) -> None:
        """Raise UsageError for a typed camera that is none of the model's, or without one for its first."""
        typed = [camera for camera, _ in self.settings.cameras]
        turned = [camera for camera, _ in self.settings.rotations if camera != EVERY_CAMERA]
        for option, names in (("--camera", typed), ("--rotate", turned)):
            if strange := [name for name in names if name not in cameras]:
                raise UsageError(
                    f"{option} {strange[0]}=…: the model has no such camera; it has {', '.join(cameras)}"
                )
        if typed and cameras[0] not in typed:
            raise UsageError(
                f"the model's first camera, {cameras[0]}, gets no picture. Map it, such as --camera "
                f"{cameras[0]}=observation/image"
            )
        if strange := [name for name in typed if "/" in name or UNSAFE.search(name)]:
            raise UsageError(f"--camera {strange[0]}=…: a run stores no pictures under this name")

    def with_cameras_of(self, policy: "Policy") -> "Policy":
        """Return the policy for the cameras that get a picture. Raises ObservationError."""
        order = [camera for camera in policy.card.cameras if camera in dict(self.cameras)]
        self.cameras = tuple((camera, dict(self.cameras)[camera]) for camera in order)
        return policy.with_cameras(order)

    def example(self, instruction: str) -> Observation:
        """Return blank pictures and a state of zeros, of the shapes that were received."""
        names = [camera for camera, _ in self.cameras] or list(self.model_cameras[:1])
        blank = {name: np.zeros(self._turned_shape(name), np.uint8) for name in names}
        size = self.state_size or self._needed_state or ARM_NUMBERS
        return _observation(blank, np.zeros(size, np.float32), instruction)

    def _turned_shape(self, camera: str) -> tuple[int, ...]:
        height, width, colours = self.pictures.get(camera, _BLANK)
        sideways = degrees_of(self.settings.rotations, camera) in (90, 270)
        return (width, height, colours) if sideways else (height, width, colours)

    # -- what arrives --------------------------------------------------------------------------------

    def receive(self, sent: Mapping[str, Any]) -> Received:
        """Return what a client sent as the model is shown it. The first one decides sizes and, untyped, cameras.

        Args:
            sent: Values by key; `/` in a key of the settings leads into nested maps.

        Raises:
            ObservationError: For a picture, state or instruction that is missing or has another size or type.
        """
        cameras = self.cameras or self._guess_cameras(sent)
        pictures = {camera: self._picture(sent, camera, key) for camera, key in cameras}
        state = self._state(sent)
        instruction = self.settings.instruction or _words(sent, self.settings.words_key)
        turned = {
            camera: np.ascontiguousarray(np.rot90(picture, degrees_of(self.settings.rotations, camera) // 90))
            for camera, picture in pictures.items()
        }
        return Received(_observation(turned, state, instruction), pictures, cameras)

    def settle(self, received: Received) -> None:
        """Let cameras and shapes of an observation be those of all later ones, and its words an example."""
        self.cameras = received.keys
        self.pictures = {camera: picture.shape for camera, picture in received.pictures.items()}
        self.state_size = len(received.observation.state) if self.settings.state else None
        self.words = [received.observation.instruction]

    def unsettle(self) -> None:
        """Forget an observation of which the model made no action: the next one decides."""
        self.cameras, self.pictures, self.state_size, self.words = self.settings.cameras, {}, None, []

    def adopt(self, stored: Mapping[str, Any], words: Sequence[str]) -> None:
        """Let cameras and shapes be those of a run, from its part `dataset`, and some of its words an example."""
        if not self.settings.cameras:
            self.cameras = tuple((camera, key) for camera, key, _ in stored["cameras"])
        self.pictures = {camera: tuple(shape) for camera, shape in stored["shapes"].items()}
        self.state_size = stored["inputs"].get("state", [None])[0]
        self.prediction = tuple(stored["inputs"]["prediction"])
        self.words = list(words)

    def read_keys(self) -> set[str]:
        """Return the keys that are read of an observation."""
        words = set() if self.settings.instruction is not None else {self.settings.words_key}
        return {key for _, key in self.cameras} | set(self.settings.state) | words

    def _guess_cameras(self, sent: Mapping[str, Any]) -> Pairs:
        """Return the cameras whose name is a key, else the first one with the only picture."""
        by_name = {
            camera: key
            for camera in self.model_cameras
            for key in _names_of(camera)
            if _find(sent, key) is not None
        }
        if self.model_cameras[0] in by_name:
            return tuple(by_name.items())
        pictures = [key for key, value in _flat(sent) if isinstance(value, np.ndarray) and value.ndim == 3]
        if len(pictures) == 1 and len(self.model_cameras) == 1:
            return ((self.model_cameras[0], pictures[0]),)
        raise ObservationError(
            f"no picture is mapped to the model's first camera: the model has {', '.join(self.model_cameras)}; "
            f"the observation has {_list_keys(pictures)}. Start the server with --camera {self.model_cameras[0]}="
            f"{pictures[0] if pictures else 'KEY'}"
        )

    def _picture(self, sent: Mapping[str, Any], camera: str, key: str) -> NDArray[np.uint8]:
        picture = _find(sent, key)
        if picture is None:
            keys = [name for name, value in _flat(sent) if isinstance(value, np.ndarray) and value.ndim == 3]
            raise ObservationError(
                f"the observation has no picture {key!r} for the camera {camera}; its pictures are "
                f"{_list_keys(keys)}. Send it, or start the server with another --camera"
            )
        if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.ndim != 3:
            raise ObservationError(
                f"{key} is {_in_words(picture)}; expected a picture of uint8, (height, width, 3) or (3, height, "
                "width)"
            )
        if picture.shape[2] != 3 and picture.shape[0] == 3:
            picture = np.moveaxis(picture, 0, 2)
        if picture.shape[2] != 3 or not all(0 < side <= MOST_SIDE for side in picture.shape[:2]):
            raise ObservationError(
                f"{key} has the shape {picture.shape}; expected (height, width, 3) or (3, height, width), and at "
                f"most {MOST_SIDE} pixels a side"
            )
        if (expected := self.pictures.get(camera)) is not None and picture.shape != expected:
            raise ObservationError(
                f"{key} has the shape {picture.shape}; the run stores pictures of {expected} for the camera "
                f"{camera}. Send that size, or serve into another --out"
            )
        return np.array(picture, order="C")  # what was decoded is read-only

    def _state(self, sent: Mapping[str, Any]) -> NDArray[np.float32]:
        if not self.settings.state:
            return np.zeros(ARM_NUMBERS, np.float32)
        parts = []
        for key in self.settings.state:
            value = _find(sent, key)
            if value is None:
                keys = [name for name, other in _flat(sent) if isinstance(other, np.ndarray) and other.ndim < 3]
                raise ObservationError(
                    f"the observation has no state {key!r}; its other numbers are {_list_keys(keys)}. Send it, or "
                    "start the server with another --state"
                )
            numbers = np.asarray(value) if isinstance(value, np.ndarray | int | float) else None
            if numbers is None or numbers.dtype.kind not in NUMBER_KINDS or numbers.ndim > 1:
                raise ObservationError(f"{key} is {_in_words(value)}; expected numbers of one axis")
            with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused below
                parts.append(np.atleast_1d(numbers).astype(np.float32))
        state = np.concatenate(parts)
        joined = ", ".join(self.settings.state)
        if not 0 < state.size <= MOST_NUMBERS or not np.isfinite(state).all():
            raise ObservationError(
                f"{joined}: the state is empty, too long, or holds NaN or infinity; send numbers"
            )
        expected = self._needed_state if self._needed_state is not None else self.state_size
        if expected is not None and state.size != expected:
            raise ObservationError(
                f"{joined}: the state has {state.size} numbers; expected {expected}. Name the keys of the state "
                "that the policy was trained on with --state"
            )
        return state

    def check_units(self, policy: "Policy", states: Sequence[NDArray[np.float32]], accepted: bool) -> Units:
        """Compare the first states of some episodes with the checkpoint's statistics.

        Raises:
            UnitsError: For other units or another robot, unless that is accepted.
        """
        if not self.settings.state:
            return Units()
        names = [str(number) for number in range(states[0].size)]
        self.units = compare_states(policy, [np.stack(states)], names, begins=True)
        check_units(self.units, f"{', '.join(self.settings.state)} at the beginning of episodes", policy, accepted)
        return self.units

    # -- what a run says of it -----------------------------------------------------------------------

    @property
    def state_names(self) -> list[str]:
        """The names of the numbers of the state; of several keys with the last part of each."""
        if self.state_size is None:
            return []
        return [str(number) for number in range(self.state_size)]

    def inputs(self) -> dict[str, list[int]]:
        """Return the shape per inference of each stored kind."""
        shapes: dict[str, list[int]] = {"prediction": list(self.prediction)}
        if self.settings.state:
            shapes["state"] = [self.state_size or 0]
        shapes["pixels"] = [len(self.cameras), SIDE, SIDE, 3]
        if self.settings.keep == "full":
            shapes |= {f"{PICTURE_OF}{camera}": list(self.pictures[camera]) for camera, _ in self.cameras}
        return dict(sorted(shapes.items()))

    def early_identity(self) -> dict[str, Any]:
        """Return the part of the identity that is known before the first observation."""
        settings = self.settings
        conditions = {condition.name: condition.to_json()["edits"] for condition in settings.conditions}
        return {
            "kind": "served",
            "wire": settings.wire,
            "source": settings.name,
            "meta_blake2b": blake2b(settings.name.encode(), digest_size=16).hexdigest(),
            "fps": 1.0,
            "frames": f"every:{settings.every}",
            "rotations": [list(turn) for turn in settings.rotations],
            "state": list(settings.state),
            "instruction": settings.instruction,
            "keep": settings.keep,
            "columns": [],
            **({"conditions": conditions} if conditions else {}),
        }

    def identity(self, execute: int) -> dict[str, Any]:
        """Return wire, map, shapes and the name of what is served."""
        del execute
        cameras = [[camera, key, "image"] for camera, key in self.cameras]
        names = {"state": self.state_names} if self.settings.state else {}
        shapes = {camera: list(shape) for camera, shape in sorted(self.pictures.items())}
        parts = {"cameras": cameras, "shapes": shapes, "inputs": self.inputs(), "names": names}
        return {DATASET: {**self.early_identity(), **parts}}

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the name of what is served; rows arrive, and are no selection."""
        del rows
        return {
            "recording": {
                "name": self.name,
                "episodes": [],
                RECORDED_EPISODES: None,
                OTHER_ACTIONS: UNKNOWN_ACTIONS,
            }
        }

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return wire and keys."""
        del rows
        turned = dict(self.settings.rotations)
        cameras = "; ".join(
            f"{camera} from {key}" + (f", rotated by {turned[camera]}°" if camera in turned else "")
            for camera, key in self.cameras
        )
        return {
            "wire": self.settings.wire,
            "cameras": terminal_safe(cameras) or "of equal names, or the only picture",
            "state": terminal_safe(", ".join(self.settings.state)) or "none",
        }

    def shown_cameras(self, declared: "DeclaredInputs | None" = None) -> tuple[str, ...] | None:
        """Return the cameras that get a picture, as far as they are known."""
        del declared
        return tuple(camera for camera, _ in self.cameras) or None

    def play(self, played: Played) -> Opens:
        """Open a player of the stored observations."""
        del played
        assert self.run is not None, "a server has no player: its clients play"
        return partial(ServedPlayer, self)


@dataclass
class ServedEpisode(ShownInputs):
    """The inputs of the captured inferences of an episode that a client plays, and the answers."""

    _contents: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._clear()

    def keep(self, received: Received, actions: NDArray[np.float32], settings: ServedSettings) -> None:
        """Keep what an inference was shown, and what was answered."""
        self._keep("prediction", actions)
        if settings.state:
            self._keep("state", received.observation.state)
        self._keep_pictures(list(received.pictures.values()), False)
        pictures = [received.observation.image, *received.observation.cameras.values()]
        self._keep("pixels", np.stack(list(map(small_picture, pictures))))
        if settings.keep == "full":
            for camera, picture in received.pictures.items():
                self._keep(f"{PICTURE_OF}{camera}", picture)
        self._contents.append(received.observation.state.tobytes() + received.observation.instruction.encode())

    @property
    def content_blake2b(self) -> str:
        """The hash of pictures, states and words of the captured inferences."""
        return blake2b(b"".join([self._hash.digest(), *self._contents]), digest_size=16).hexdigest()

    def ending(self, outcome: Mapping[str, Any]) -> Ending:
        """Return the end of the episode."""
        return self._ending(outcome)


class ServedPlayer(InputsPlayer):
    """A player that shows the stored observations of a run again."""

    def __init__(self, source: ServedSource) -> None:
        assert source.run is not None
        self._source, self._run = source, source.run
        self._rows = {row.episode_id: (position, row) for position, row in enumerate(source.rows(0))}
        self._kept: tuple[int, dict[str, NDArray[Any]]] = (-1, {})

    def begin(self, row: Row, film: bool) -> Answer:
        """Show the observation of a captured inference, by its control step."""
        del film
        assert row.frames is not None, "stored rows have frames"
        position, stored = self._rows[row.episode_id]
        assert stored.frames is not None, "stored rows have frames"
        call = stored.frames.index(row.frames[0])
        inputs = self._inputs_at(position)
        turned = {}
        for camera, _ in self._source.cameras:
            degrees = degrees_of(self._source.settings.rotations, camera)
            turned[camera] = np.ascontiguousarray(np.rot90(inputs[f"{PICTURE_OF}{camera}"][call], degrees // 90))
        state = inputs["state"][call] if "state" in inputs else np.zeros(ARM_NUMBERS, np.float32)
        return _observation(turned, state, row.instruction)

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Raise NotImplementedError: what a client did with an answer is not known."""
        raise NotImplementedError

    def _inputs_at(self, position: int) -> dict[str, NDArray[Any]]:
        """Return the stored inputs of one row, which are kept until another row is read."""
        if self._kept[0] != position:
            inputs = self._run.inputs
            assert inputs is not None, "a served run has inputs"
            kinds = [kind for kind in inputs.kinds if kind == "state" or kind.startswith(PICTURE_OF)]
            self._kept = position, {kind: inputs.row(kind, position) for kind in kinds}
        return self._kept[1]


def _observation(
    pictures: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float32], instruction: str
) -> Observation:
    first, *later = pictures
    return Observation(pictures[first], state, instruction, None, {name: pictures[name] for name in later})


def _find(sent: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key, else what its parts lead to in nested maps; None without one."""
    if key in sent:
        return sent[key]
    value: Any = sent
    for part in key.split("/"):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _flat(sent: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return keys and values, of nested maps with their path."""
    pairs: list[tuple[str, Any]] = []
    for key, value in sent.items():
        name = f"{prefix}{key}"
        pairs += _flat(value, f"{name}/") if isinstance(value, Mapping) else [(name, value)]
    return pairs


def flat_keys(sent: Mapping[str, Any]) -> dict[str, str]:
    """Return type and shape in words by key of what a client sent, of nested maps with their path."""
    return {key: _in_words(value) for key, value in _flat(sent)}


def _names_of(camera: str) -> tuple[str, ...]:
    return camera, f"images/{camera}", f"observation/{camera}", f"observation.images.{camera}"


def _list_keys(keys: Sequence[str]) -> str:
    return terminal_safe(", ".join(keys)[:300]) or "none"


def _in_words(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return f"a {type(value).__name__}"


def _words(sent: Mapping[str, Any], key: str) -> str:
    """Return the instruction. Raises ObservationError for none, and for what is no plain text."""
    text: Any = _find(sent, key)
    if isinstance(text, bytes):
        text = text.decode(errors="replace")
    if not isinstance(text, str) or not text.strip():
        described = "none" if text is None else f"{text!r:.80}"
        raise ObservationError(
            f"the observation has no words: {key} is {described}; expected a text. Send it, or start the "
            "server with --instruction TEXT"
        )
    if UNSAFE.search(text) or len(text) > LONGEST_WORDS:
        raise ObservationError(
            f"the instruction holds control characters or more than {LONGEST_WORDS} characters; send plain text"
        )
    return text
