"""A stage that shows recorded frames: what a policy predicts about one changes nothing of the next."""

from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.errors import ProbeKitError, RecordingError
from probe_kit.extract.recordings.lerobot_folder import open_lerobot
from probe_kit.extract.recordings.recorded_plan import SIDE, PlannedStretch, Recording
from probe_kit.extract.rollout.stage import Answer, Ending, TimedStage
from probe_kit.extract.sources.recording import ACTION, STATE, LeRobotSource
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.state_layout import ARM_NUMBERS
from probe_kit.runs.layout import CAPTURE_ONLY, FrameChoice

NO_STATE = np.zeros(ARM_NUMBERS, np.float32)
"""What a policy that reads no state is given of a data set without one."""


class RecordedStage(TimedStage):
    """Shows the stretches of one data set, frame by frame, and keeps what controls are made of.

    source: with every camera of the model mapped.
    """

    def __init__(self, source: LeRobotSource, script: None = None, frames: FrameChoice = "none") -> None:
        del script, frames
        self._recording = Recording.of(open_lerobot(source), source)

    def begin(self, planned: PlannedStretch, film: bool) -> Answer:
        """Show the first frame of a stretch. Errors carry a note naming it."""
        del film
        self._planned, self._position = planned, 0
        self._inputs: dict[str, list[NDArray[Any]]] = {}
        self._frames = blake2b(digest_size=16)
        try:
            recording = self._recording
            self._check_content(planned)
            wanted = [name for name in (STATE, ACTION) if recording.folder.width(name) is not None]
            self._numbers = recording.reader.numbers(planned.source_episode, [*wanted, *recording.folder.columns])
            return self._see()
        except ProbeKitError as error:
            raise self._named(error) from None

    def advance(self, chunk: NDArray[np.float32]) -> Answer:
        """Keep the chunk (chunk, D) that was predicted for the frame, and show the next one."""
        try:
            self._keep("prediction", chunk)
            if ACTION in self._numbers:
                self._keep("action", _ahead(self._numbers[ACTION], self._frame, len(chunk)))
            self._position += 1
            return self._see() if self._position < self._planned.count else self._end()
        except ProbeKitError as error:
            raise self._named(error) from None

    def _check_content(self, planned: PlannedStretch) -> None:
        """Raise RecordingError unless the files of an episode are those that the plan was made of."""
        recording = self._recording
        now = recording.folder.content_blake2b(planned.source_episode, recording.features)
        if now != planned.content:
            raise RecordingError(
                f"{recording.folder.path.name}: the files of {planned.item_id} were changed after the run was "
                f"planned: their hash was {planned.content}, now it is {now}. Leave the data set as it is until "
                "the run ends"
            )

    @property
    def _frame(self) -> int:
        return self._planned.frames[self._position]

    def _see(self) -> Observation:
        recording, frame = self._recording, self._frame
        found = recording.reader.pictures(self._planned.source_episode, frame, recording.features)
        pictures = {camera: found[feature] for camera, feature in recording.source.cameras}
        for camera, degrees in recording.source.rotations:
            pictures[camera] = np.ascontiguousarray(np.rot90(pictures[camera], degrees // 90))
        for picture in pictures.values():
            self._frames.update(f"{picture.shape}".encode() + picture.tobytes())
        state = NO_STATE
        if STATE in self._numbers:
            state = self._numbers[STATE][frame].astype(np.float32)
            self._keep("state", state)
        self._keep("columns", np.array([self._numbers[name][frame, 0] for name in recording.folder.columns]))
        if recording.source.pixels:
            self._keep("pixels", np.stack([small_picture(picture) for picture in pictures.values()]))
        return observation_of(pictures, state, self._planned.instruction)

    def _keep(self, name: str, values: NDArray[Any]) -> None:
        self._inputs.setdefault(name, []).append(np.array(values))

    def _end(self) -> Ending:
        outcome = {"outcome": CAPTURE_ONLY, "frames_blake2b": self._frames.hexdigest()}
        return Ending(outcome, [], inputs={name: np.stack(rows) for name, rows in self._inputs.items()})

    def _named(self, error: ProbeKitError) -> ProbeKitError:
        error.add_note(f"in {self._planned.episode_id} ({self._planned.instruction!r})")
        return error


def observation_of(
    pictures: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float32], instruction: str
) -> Observation:
    """What a policy sees of pictures by camera, the first of which is the main one."""
    first, *others = pictures
    return Observation(pictures[first], state, instruction, None, {name: pictures[name] for name in others})


def example_of(recording: Recording, instruction: str) -> Observation:
    """A blank observation of the recording's shapes."""
    folder = recording.folder
    turned = dict(recording.source.rotations)
    pictures = {}
    for camera, feature in recording.source.cameras:
        height, width = folder.picture_shape(feature)
        shape = (width, height) if turned.get(camera) in (90, 270) else (height, width)
        pictures[camera] = np.zeros((*shape, 3), np.uint8)
    numbers = folder.width(STATE)
    return observation_of(pictures, NO_STATE if numbers is None else np.zeros(numbers, np.float32), instruction)


def _ahead(actions: NDArray[np.float64], frame: int, count: int) -> NDArray[np.float32]:
    """(count, D) the recorded actions from a frame on; behind the end of the episode they are not numbers."""
    found = np.full((count, actions.shape[1]), np.nan, np.float32)
    own = actions[frame : frame + count]
    found[: len(own)] = own
    return found


def small_picture(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(SIDE, SIDE, 3): each pixel the mean of its part of the picture."""
    return np.asarray(Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.BOX))
