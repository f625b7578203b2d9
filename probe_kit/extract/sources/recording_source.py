"""Opened recordings: chosen frames of a LeRobotDataset on this machine, and the player that shows them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial
from importlib.metadata import version
from itertools import groupby
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import describe_range
from probe_kit._system.escaping import terminal_safe
from probe_kit.errors import ObservationError, RecordingError
from probe_kit.extract.sources.lerobot_folder import (
    MOST_FRAMES,
    LeRobotFolder,
    LeRobotFrames,
    fetch_episodes,
    open_lerobot,
)
from probe_kit.extract.sources.lerobot_meta import IMAGE, KEYS, NUMERIC
from probe_kit.extract.sources.player import SIDE, Answer, InputsPlayer, Opens, frames_of_episode
from probe_kit.extract.sources.recording import EVERY_CAMERA, LeRobotSource, Pairs, degrees_of
from probe_kit.extract.sources.source import (
    ACTION_UNITS,
    Played,
    Source,
    check_units,
    compare_states,
    other_order,
    predicted_once,
    raise_together,
)
from probe_kit.extract.sources.units import Units, UnitsNote, compare_units
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.card import DeclaredInputs
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation
from probe_kit.hooks.families.shared.feature_names import read_names
from probe_kit.hooks.families.shared.kinds import ACTION, IMAGES, STATE, map_text, renamed_features
from probe_kit.runs.input_content import EpisodeFrames, content_notes
from probe_kit.runs.layout import CAPTURE_ONLY, DATASET, OTHER_ACTIONS, RECORDED_EPISODES, TRUTHS
from probe_kit.runs.plan import Row

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

CATEGORY = "all"
"""The category of every row: recordings have no categories."""
NO_STATE = np.zeros(ARM_NUMBERS, np.float32)
"""The state for a policy that reads none, of a data set without one."""
NAMED = 0.01
"""The share of unusual values of a number of the state, from which on it is named."""
_LONGEST = 12
"""The most tasks and numbers that are listed."""
LOOKED_AT = 4
"""The episodes of which three pictures are decoded before a run, spread over the chosen ones."""
_TASK = "task_index"


class RecordingSource(Source[LeRobotSource]):
    """A data set on this machine, and what was chosen of it.

    Attributes:
        prediction: The shape (chunk, D) of a prediction of the policy that was checked.
        action_units: The comparison of the recorded actions with the statistics of the policy that was checked.
        other_actions: The reason why recorded actions are not what the policy predicts; None if they are.
        declared: The inputs that a checkpoint declares; None before it was looked at.
        renamed: The checkpoint's own map of names in words, and what contradicts it; empty where it has none.

    Args:
        settings: The chosen episodes, frames and cameras.
        folder: The data set.
        stretch: The most frames of a row.

    Raises:
        RecordingError: For an episode that the data set lacks.
    """

    executes = False
    groups = "recorded episodes"

    def __init__(self, settings: LeRobotSource, folder: LeRobotFolder, stretch: int = MOST_FRAMES) -> None:
        """Select the episodes and prepare to read them."""
        self.settings, self.folder, self.stretch = settings, folder, stretch
        self.episodes = tuple(folder.select_episodes(settings.episodes))
        self.reader = LeRobotFrames(folder)
        self.prediction: tuple[int, int] = (0, 0)
        self.other_actions: str | None = None
        self.action_units = Units()
        self.declared: DeclaredInputs | None = None
        self.renamed = ""

    @classmethod
    def open(cls, settings: LeRobotSource, selects_only: bool) -> Self:
        """Open the data set, with the numbers of the chosen episodes on this machine. Raises as `open_lerobot`."""
        del selects_only
        folder = open_lerobot(settings)
        if folder.repo is not None:
            settings = settings.changed(folder=f"{folder.repo}@{folder.revision}")
        opened = cls(settings, folder, 1 if settings.single else MOST_FRAMES)
        opened._check_features()
        fetch_episodes(opened.folder, opened.episodes, ())
        opened.folder.check_files(opened.episodes, ())
        return opened

    def for_questions(self) -> Self:
        """Return the same recordings with a row per chosen frame."""
        return type(self)(self.settings, self.folder, 1)

    def for_cameras(self, cameras: Sequence[str]) -> Self:
        """Map the model's first camera, and read all numbers of the chosen episodes."""
        mapped = self.mapped(DeclaredInputs(tuple(cameras[:1])))
        fetch_episodes(mapped.folder, mapped.episodes, mapped.features)
        mapped.check_frames()
        return mapped

    def decided(self) -> Mapping[str, Any]:
        """Return settings by which every frame of a row is captured and nothing acts.

        A revision of the hub becomes its commit.
        """
        calls = self.most_frames
        return {"source": self.settings, "captured_calls": calls, "capture_only": True, "frames": "none"}

    @property
    def features(self) -> list[str]:
        """The pictures of the data set, in the order of the model's cameras."""
        return [feature for _, feature in self.settings.cameras]

    @property
    def most_frames(self) -> int:
        """The number of chosen frames of the longest row that any episode of the data set can have."""
        return min(self.stretch, -(-max(self.folder.lengths, default=1) // self.settings.every))

    @cached_property
    def instructions(self) -> tuple[str, ...]:
        """The instructions, each once, in alphabetical order."""
        return tuple(sorted({text for episode in self.episodes for text in self._texts(episode)}))

    def same_instructions(self) -> list[str]:
        """Return a sentence, without its stop, for tasks of one text or of texts that differ in spelling alone."""
        if self.settings.instruction is not None:
            return []
        numbers: dict[str, list[int]] = {}
        for number, text in self.folder.tasks:
            if text in self.instructions:
                numbers.setdefault(text, []).append(number)
        return [
            *(
                f"tasks {', '.join(map(str, sorted(of_text)))} of {self.name} have one text, {text!r}"
                for text, of_text in numbers.items()
                if len(of_text) > 1
            ),
            *super().same_instructions(),
        ]

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return stretches of the chosen episodes, in order."""
        return tuple(row for row in self._rows(seed))

    def _rows(self, seed: int) -> Iterator[Row]:
        every, index = self.settings.every, 0
        for episode in self.episodes:
            texts, content = self._texts(episode), self.folder.content_blake2b(episode, self.features)
            item, part = f"episode-{episode:06d}", 0
            shown_frames = range(0, len(texts), every)
            for text, group in groupby(shown_frames, key=lambda frame, texts=texts: texts[frame]):  # type: ignore[misc]
                frames = list(group)
                for start in range(0, len(frames), self.stretch):
                    stretch = frames[start : start + self.stretch]
                    columns = {
                        "episode_id": item + (f".{part}" if part else ""),
                        "item_id": item,
                        "category": CATEGORY,
                        "group_id": item,
                        "instruction": text,
                        "source_episode": episode,
                        "first_frame": stretch[0],
                        "frame_step": every,
                        "frames": len(stretch),
                        "recorded_frames": len(texts),
                        "policy_seed": derive_seed(seed, "policy", item),
                        "content_blake2b": content,
                    }
                    yield Row(index, columns, frames=tuple(stretch))
                    index, part = index + 1, part + 1

    def _texts(self, episode: int) -> list[str]:
        """Return the instruction at every frame of an episode."""
        if self.settings.instruction is not None:
            return [self.settings.instruction] * self.folder.lengths[episode]
        return [self._task_texts[number] for number in self._task_numbers(episode)]

    def _task_numbers(self, episode: int) -> list[int]:
        """Return the number of the task at every frame of an episode."""
        return self.reader.numbers(episode, [_TASK])[_TASK][:, 0].astype(int).tolist()  # type: ignore[no-any-return]

    @cached_property
    def _task_texts(self) -> dict[int, str]:
        """The texts of the tasks of the chosen episodes, by number. Raises RecordingError for an empty one."""
        episodes_of: dict[int, list[int]] = {}
        for episode in self.episodes:
            for number in dict.fromkeys(self._task_numbers(episode)):
                episodes_of.setdefault(number, []).append(episode)
        return {number: self.folder.task(number, episodes) for number, episodes in episodes_of.items()}

    # -- a model -------------------------------------------------------------------------------------

    def early_checks(self, inputs: DeclaredInputs, checkpoint: str) -> list[Callable[[], object]]:
        """Return checks of the cameras and the width of the state."""
        self.declared = inputs
        return [
            lambda: self.mapped(inputs),
            lambda: self.with_renamed(inputs.renames).check_state_width(checkpoint, inputs.state),
        ]

    def shown_cameras(self, declared: DeclaredInputs | None = None) -> tuple[str, ...] | None:
        """Return the cameras to which a feature was mapped, or would be mapped."""
        pairs = self.settings.cameras if declared is None else self.mapped(declared).settings.cameras
        return tuple(camera for camera, _ in pairs) or None

    def mapped(self, inputs: DeclaredInputs) -> Self:
        """Return the same recordings with a feature for the model's cameras. Raises RecordingError without."""
        pairs = mapped_cameras(self.settings.cameras, inputs.cameras, self.folder.cameras, inputs.renames)
        names = [camera for camera, _ in pairs]
        rotations = self.settings.rotations
        if strange := [camera for camera, _ in rotations if camera not in (*names, EVERY_CAMERA)]:
            raise RecordingError(
                f"--rotate {strange[0]}=…: that camera gets no picture; those with one are {', '.join(names)}"
            )
        turns = {camera: turn for camera in names if (turn := degrees_of(rotations, camera))}
        renamed = self.with_renamed(inputs.renames)
        settings = renamed.settings.changed(cameras=pairs, rotations=turns)
        mapped = type(self)(settings, renamed.folder, self.stretch)
        mapped.renamed = self._describe_renames(inputs)
        return mapped

    def with_renamed(self, renames: Mapping[str, str]) -> Self:
        """Return the same recordings, whose state is the feature that a checkpoint's own map names.

        A feature that the settings name counts over it.

        Raises:
            RecordingError: If the map gives the name of the state to several features, or takes it away.
        """
        features = self.folder.info["features"]
        if not renames or STATE in dict(self.settings.features):
            return self
        sources = renamed_features(features, renames).get(STATE, [])
        if len(sources) > 1 or (not sources and STATE in features):
            several = f"{' and '.join(sources)} both become {STATE}" if sources else f"nothing becomes {STATE}"
            raise RecordingError(
                f"the checkpoint's rename map ({map_text(renames)}) does not say which feature of "
                f"{self.folder.path.name} is the state: {several}. Give it with --feature {STATE}=FEATURE"
            )
        if not sources or sources == [STATE]:
            return self
        pairs = (*self.settings.features, (STATE, sources[0]))
        return type(self)(self.settings.changed(features=pairs), self.folder.with_features(pairs), self.stretch)

    def _describe_renames(self, inputs: DeclaredInputs) -> str:
        """Return the checkpoint's own map in words, and where the settings contradict it; empty without one."""
        renames, typed = inputs.renames, {f"{IMAGES}{camera}": name for camera, name in self.settings.cameras}
        typed |= dict(self.settings.features)
        by_name = renamed_features(self.folder.info["features"], renames)
        unlike = [
            f"{name.removeprefix(IMAGES)} is given {feature}, and the map says {' or '.join(by_name[name])}"
            for name, feature in typed.items()
            if renames and feature not in by_name.get(name, [feature])
        ]
        actions = [name for name, renamed in renames.items() if ACTION in (name, renamed)]
        ignored = f"; not {actions[0]}: lerobot renames observations alone" if actions else ""
        options = f"; contradicted by --camera or --feature: {'; '.join(unlike)}" if unlike else ""
        return terminal_safe(f"{map_text(renames)}{ignored}{options}") if renames else ""

    def check_state_width(self, checkpoint: str, expected: int | None) -> None:
        """Raise RecordingError unless the recorded state has as many numbers as the model reads."""
        width = self.folder.width(STATE)
        if expected is None or width == expected:
            return
        described = "no " + STATE if width is None else f"{width} numbers as {STATE}"
        similar = self._of_width(expected, STATE)
        way_out = (
            f"Its {' and '.join(map(repr, similar))} {'has' if len(similar) == 1 else 'have'} {expected} numbers: "
            f"if that is the state, give --feature {STATE}={similar[0]}"
            if similar
            else "Take the data set's own checkpoint, or a data set of this robot"
        )
        raise RecordingError(f"{self.folder.path.name} has {described}; {checkpoint} reads {expected}. {way_out}")

    def _of_width(self, width: int, name: str) -> list[str]:
        """Return features with so many numbers that may be the state, or the action, under another name."""
        return [
            feature
            for feature, entry in self.folder.features.items()
            if feature not in (*KEYS, STATE, ACTION)
            and entry["dtype"] in NUMERIC
            and tuple(entry["shape"]) == (width,)
            and ("action" in feature.lower()) == (name == ACTION)
        ]

    def check_frames(self) -> None:
        """Raise RecordingError for files, numbers or pictures of the chosen episodes that cannot be shown.

        Pictures are those of the mapped cameras, or of all where none is mapped. Those of a hub data set are not
        on this machine before cameras are mapped.
        """
        features = self.features or ([] if self.folder.repo is not None else self.folder.cameras)
        self.folder.check_files(self.episodes, features)
        self.reader.check(self.episodes, features)

    def _check_features(self) -> None:
        """Raise RecordingError for a mapped picture that the data set lacks, of which nothing could be hashed."""
        if strange := [feature for feature in self.features if feature not in self.folder.cameras]:
            raise RecordingError(
                f"{self.folder.path.name} has no picture {strange[0]!r}; it has "
                f"{', '.join(self.folder.cameras) or 'none'}. Correct --camera"
            )

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Map the cameras, read all numbers of the chosen episodes, and let the policy predict once about nothing.

        Raises:
            RecordingError: For cameras, states or files that do not fit.
            UnitsError: For states far outside the checkpoint's statistics.
            CheckpointError: For a checkpoint without statistics.
        """
        card = policy.card
        inputs = card.inputs(policy.state_numbers)
        raise_together(self.early_checks(inputs, card.checkpoint))
        fitted = self.mapped(inputs)
        fetch_episodes(fitted.folder, fitted.episodes, fitted.features)
        fitted.check_frames()
        try:
            policy = policy.with_cameras([camera for camera, _ in fitted.settings.cameras])
        except ObservationError as error:
            raise RecordingError(f"{error}. Map the model's first cameras with --camera") from error
        numbers = fitted._recorded_numbers()
        if STATE in numbers:
            fitted.units = fitted._state_units(policy, numbers[STATE])
        chunk = predicted_once(policy, fitted.example(fitted.instructions[0]))
        fitted.prediction = chunk.shape[0], chunk.shape[1]
        fitted.other_actions = fitted._other_actions(policy, chunk.shape[1], numbers.get(ACTION))
        fitted.check_recorded_units(policy, accept_units)
        return fitted, policy

    def check_recorded_units(self, policy: "Policy", accepted: bool) -> None:
        """Raise UnitsError for recorded states in other units than the checkpoint's, unless that is accepted."""
        check_units(self.units, f"{self.folder.path.name}, {STATE}", policy, accepted)

    def _recorded_numbers(self) -> dict[str, list[NDArray[np.float32]]]:
        """Return state and action (T, D) of every chosen episode, all its frames, as far as they are recorded."""
        names = [name for name in (STATE, ACTION) if self.folder.width(name) is not None]
        episodes = [self.reader.numbers(episode, names) for episode in self.episodes]
        return {name: [numbers[name].astype(np.float32) for numbers in episodes] for name in names}

    def _state_units(self, policy: "Policy", episodes: list[NDArray[np.float32]]) -> Units:
        if not all(np.isfinite(states[:: self.settings.every]).all() for states in episodes):
            name = self.folder.path.name
            raise RecordingError(f"{name}: {STATE} holds NaN or infinity; leave such episodes out")
        return compare_states(policy, episodes, self.folder.names(STATE), self.folder.statistics(STATE))

    def _other_actions(
        self, policy: "Policy", predicted: int, actions: list[NDArray[np.float32]] | None
    ) -> str | None:
        """Return why the recorded actions are not what a policy predicts; None without a sign of that."""
        if actions is None:
            similar = self._of_width(predicted, ACTION)
            how = f"; if {similar[0]!r} are the actions, give --feature {ACTION}={similar[0]}" if similar else ""
            return f"the data set has no actions{how}"
        if (width := actions[0].shape[1]) != predicted:
            return f"the policy predicts {predicted} numbers, the data set has {width}"
        if policy.predicts_relative:
            return "the policy predicts changes relative to the state (use_relative_actions)"
        if (reason := other_order(policy, self.folder.feature_names(ACTION) or ())) is not None:
            return reason
        names, misfit = read_names(self.folder.features[ACTION].get("names")), self.folder.names_misfit(ACTION)
        if policy.action_names is not None and misfit and (names is None or len(names) > 1):
            return f"the checkpoint names its actions {', '.join(policy.action_names)}; of the data set, {misfit}"
        if (expected := policy.action_statistics) is None:
            return None
        number_names, recorded = self.folder.names(ACTION), self.folder.statistics(ACTION)
        self.action_units = compare_units(expected, actions, number_names, recorded)
        refused = self.action_units.refused
        return f"recorded actions do not fit the statistics of the checkpoint: {refused}" if refused else None

    def example(self, instruction: str) -> Observation:
        """Return blank pictures and a state of zeros."""
        turned, pictures = dict(self.settings.rotations), {}
        for camera, feature in self.settings.cameras:
            height, width = self.folder.picture_shape(feature)
            shape = (width, height) if turned.get(camera) in (90, 270) else (height, width)
            pictures[camera] = np.zeros((*shape, 3), np.uint8)
        numbers = self.folder.width(STATE)
        state = NO_STATE if numbers is None else np.zeros(numbers, np.float32)
        return observation_of(pictures, state, instruction, self.intrinsics)

    @cached_property
    def intrinsics(self) -> NDArray[np.float32] | None:
        """The (3, 3) matrix of the first camera, as the data set gives it; None where its pictures are turned."""
        camera, feature = self.settings.cameras[0]
        return None if camera in dict(self.settings.rotations) else self.folder.intrinsics(feature)

    def play(self, played: Played) -> Opens:
        """Open a player, which opens the data set again."""
        del played
        return partial(RecordingPlayer, self.settings)

    def content_notes(self) -> tuple[str, ...]:
        """Return a sentence for every input without content, in frames that are spread over a few chosen episodes.

        Pictures are those of the mapped cameras; before, those of all cameras of a data set on this machine.
        """
        return self._content_notes

    @cached_property
    def _content_notes(self) -> tuple[str, ...]:
        every = [] if self.folder.repo is not None else [(name, name) for name in self.folder.cameras]
        pairs, frames = self.settings.cameras or tuple(every), []
        at = np.linspace(0, len(self.episodes) - 1, min(len(self.episodes), LOOKED_AT)).round().astype(int)
        for episode in (self.episodes[number] for number in at):
            # A picture that is not here yet, or cannot be read, costs its own episode when it is played.
            with suppress(RecordingError):
                frames.append(self._frames(episode, [feature for _, feature in pairs]))
        lossy = [name for name, feature in pairs if self.folder.is_video(feature)]
        return tuple(content_notes(frames, [name for name, _ in pairs], lossy))

    def _frames(self, episode: int, features: Sequence[str]) -> EpisodeFrames:
        """Return the first, the middle and the last chosen frame of an episode, and the states of all of them."""
        selection = range(0, self.folder.lengths[episode], self.settings.every)
        frames = [selection[number] for number in sorted({0, len(selection) // 2, len(selection) - 1})]
        pictures = [list(self.reader.pictures(episode, frame, features).values()) for frame in frames]
        state = None
        if self.folder.width(STATE) is not None:
            state = self.reader.numbers(episode, [STATE])[STATE][:: self.settings.every]
        return frames_of_episode(str(episode), pictures, state)

    # -- what a run says of it -----------------------------------------------------------------------

    def identity(self, execute: int) -> dict[str, Any]:
        """Return the data set by its content, and how it is shown."""
        settings, folder = self.settings, self.folder
        state, action = folder.width(STATE), folder.width(ACTION)
        shapes: dict[str, list[int]] = {"prediction": list(self.prediction)} if execute else {}
        shapes |= {"columns": [len(folder.columns)]} if folder.columns else {}
        shapes |= {} if state is None else {"state": [state]}
        shapes |= {"action": [self.prediction[0], action]} if action is not None and execute else {}
        shapes |= {"pixels": [len(settings.cameras), SIDE, SIDE, 3]} if settings.pixels else {}
        truths = [name for name in folder.columns if folder.features[name]["dtype"] == "bool"]
        data_set = {
            "kind": "lerobot",
            **({} if folder.repo is None else {"repo": folder.repo, "revision": folder.revision}),
            "meta_blake2b": folder.meta_blake2b,
            "fps": folder.fps,
            "frames": f"every:{settings.every}",
            "cameras": [[camera, feature, folder.encoding(feature)] for camera, feature in settings.cameras],
            **({"features": [list(pair) for pair in settings.features]} if settings.features else {}),
            "rotations": [list(turn) for turn in settings.rotations],
            "instruction": settings.instruction,
            "inputs": dict(sorted(shapes.items())),
            "columns": folder.columns,
            "names": {
                **{
                    name: folder.names(feature)
                    for name, feature, width in (("state", STATE, state), ("action", ACTION, action))
                    if width is not None
                },
                **({TRUTHS: truths} if truths else {}),
            },
        }
        return {DATASET: data_set}

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the selected episodes, and why their actions are not compared with predicted ones."""
        episodes = sorted({row.columns["source_episode"] for row in rows})
        recording = {"name": self.name, "episodes": episodes, RECORDED_EPISODES: len(self.folder.lengths)}
        return {"recording": {**recording, OTHER_ACTIONS: self.other_actions}}

    @property
    def decoder(self) -> str | None:
        """The version of PyAV where a camera is a video: pixels of lossy videos are those of their decoder."""
        encodings = {self.folder.encoding(feature) for feature in self.features}
        return f"PyAV {version('av')}" if encodings - {IMAGE} else None

    def targets(self) -> tuple[str, ...]:
        """Return the recorded numbers."""
        parts = [("state", STATE), ("action", ACTION)]
        numbers = [f"dataset.{part}.{name}" for part, feature in parts for name in self._names(feature)]
        return (*numbers, *(f"dataset.{name}" for name in self.folder.columns))

    def _names(self, feature: str) -> list[str]:
        return [] if self.folder.width(feature) is None else self.folder.names(feature)

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return data set, cameras and frames of a plan."""
        planned = self.mapped(self.declared) if self.declared and not self.settings.cameras else self
        settings, folder, turned = planned.settings, self.folder, dict(self.settings.rotations)
        renamed = planned.renamed or (self._describe_renames(self.declared) if self.declared else "")
        cameras = [
            f"{camera} from {feature} ({folder.encoding(feature)})"
            + (f", rotated by {turned[camera]}°" if camera in turned else "")
            for camera, feature in settings.cameras
        ]
        where = self.name if folder.repo is None else f"{folder.repo}@{folder.revision}"
        frames, episodes = (
            sum(row.columns["frames"] for row in rows),
            {row.columns["source_episode"] for row in rows},
        )
        return {
            "data set": f"{terminal_safe(where)}, {folder.fps:g} frames per second",
            "cameras": terminal_safe("; ".join(cameras)) or "mapped when the model is loaded",
            **({"features": terminal_safe(_features_text(settings.features))} if settings.features else {}),
            **({"rename map": renamed} if renamed else {}),
            "frames": f"{frames} of {len(episodes)} episodes (every:{settings.every}), in {len(rows)} rows",
            **({"names not used": "; ".join(misfits)} if (misfits := self._name_misfits()) else {}),
        }

    def _name_misfits(self) -> list[str]:
        """Return why names of state or action are not used, by feature."""
        folder = self.folder
        features = (name for name in (STATE, ACTION) if name in folder.features)
        return [terminal_safe(f"{name}: {misfit}") for name in features if (misfit := folder.names_misfit(name))]

    def facts(self) -> dict[str, str]:
        """Return format, episodes, frames, tasks and features of the data set, in words, for `dataset show`."""
        folder, lengths = self.folder, [self.folder.lengths[episode] for episode in self.episodes]
        every, texts = self.settings.every, self.instructions
        more = f" and {len(texts) - _LONGEST} more" if len(texts) > _LONGEST else ""
        return {
            "data set": self.name + (f"@{folder.revision}" if folder.revision else ""),
            "frames per second": f"{folder.fps:g}",
            "episodes": f"{len(lengths)} of {len(folder.lengths)}, {describe_range(lengths)} frames each",
            "frames": f"{sum(-(-length // every) for length in lengths)} of {sum(lengths)} (every:{every})",
            "instructions": "; ".join(texts[:_LONGEST]) + more,
            **({"same instruction": "; ".join(same)} if (same := self.same_instructions()) else {}),
            "cameras": "; ".join(map(self._camera, folder.cameras)) or "none",
            STATE: self._numbers(STATE),
            ACTION: self._numbers(ACTION),
            "columns": ", ".join(folder.columns) or "none",
            **({} if (drift := self.reader.largest_drift) is None else {"largest time drift": str(drift)}),
            "data sha": f"meta {folder.meta_blake2b[:12]}",
        }

    def unit_notes(self, accepted: bool) -> dict[str, UnitsNote]:
        """Return what does not fit of states, and of actions where they are compared nonetheless."""
        note = None if self.action_units.are_other else self.action_units.note(accepted)
        return super().unit_notes(accepted) | ({} if note is None else {ACTION_UNITS: note})

    def facts_of(self, policy: "Policy", accepted: bool = False) -> dict[str, str]:
        """Describe how a policy that fits is shown the data set.

        Args:
            policy: The policy that was checked.
            accepted: Whether other units were accepted.
        """
        mapped = dict(self.settings.cameras)
        masked = [camera for camera in policy.card.cameras if camera not in mapped]
        chunk, width = self.prediction
        recorded = self.folder.width(ACTION)
        return {
            "model": f"{policy.card.family}  weights {policy.card.weights_sha256[:12]}",
            "shown": "; ".join(f"{camera} from {feature}" for camera, feature in mapped.items())
            + (f"; without a picture: {', '.join(masked)}" if masked else ""),
            **({"features": _features_text(self.settings.features)} if self.settings.features else {}),
            **({"rename map": self.renamed} if self.renamed else {}),
            "predicts": f"{chunk} actions of {width} numbers; the data set has {recorded or 'no actions'}"
            + (f" of {recorded} numbers" if recorded and recorded != width else ""),
            "recorded actions": "not compared: " + self.other_actions
            if self.other_actions
            else "compared with the recorded ones, see `probe-kit run show RUN --action-errors`",
            "state": self._shares(),
            **{name: note.words for name, note in self.unit_notes(accepted).items()},
        }

    def _shares(self) -> str:
        if not self.units.shares.size:
            return "not compared: this model normalises no state"
        names = self.folder.names(STATE)
        shares = [
            f"{names[number]} {share:.0%}" for number, share in enumerate(self.units.shares) if share >= NAMED
        ]
        return "outside the checkpoint's statistics: " + (
            ", ".join(shares[:_LONGEST]) or "less than 1 % of each number"
        )

    def _camera(self, feature: str) -> str:
        height, width = self.folder.picture_shape(feature)
        return f"{feature} {width}×{height} ({self.folder.encoding(feature)})"

    def _numbers(self, feature: str) -> str:
        width = self.folder.width(feature)
        if width is None:
            return "none"
        misfit = self.folder.names_misfit(feature)
        listed = ", ".join(self.folder.names(feature)[:_LONGEST])
        return f"{width} numbers: {listed}" + (f" ({misfit})" if misfit else "")


class RecordingPlayer(InputsPlayer):
    """A player that shows the stretches of one data set, frame by frame, and keeps what controls are made of.

    The settings have every camera of the model mapped.
    """

    def __init__(self, settings: LeRobotSource) -> None:
        self._recording = RecordingSource(settings, open_lerobot(settings))

    def begin(self, row: Row, film: bool) -> Answer:
        """Show the first frame of a stretch."""
        del film
        self.row, self._position = row, 0
        self._clear()
        self._check_content(row)
        recording = self._recording
        names = [name for name in (STATE, ACTION) if recording.folder.width(name) is not None]
        self._numbers = recording.reader.numbers(
            row.columns["source_episode"], [*names, *recording.folder.columns]
        )
        return self._see()

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Keep the chunk (chunk, D) that was predicted for the frame, and show the next one."""
        self._keep("prediction", actions)
        if ACTION in self._numbers:
            self._keep("action", _ahead(self._numbers[ACTION], self._frame, len(actions)))
        self._position += 1
        assert self.row.frames is not None
        return self._see() if self._position < len(self.row.frames) else self._ending({"outcome": CAPTURE_ONLY})

    def _check_content(self, row: Row) -> None:
        """Raise RecordingError unless the files of an episode are those from which the plan was made."""
        recording, planned = self._recording, row.columns["content_blake2b"]
        now = recording.folder.content_blake2b(row.columns["source_episode"], recording.features)
        if now != planned:
            raise RecordingError(
                f"{recording.folder.path.name}: the files of {row.columns['item_id']} were changed after the run "
                f"was planned: their hash was {planned}, now it is {now}. Leave the data set as it is "
                "until the run ends"
            )

    @property
    def _frame(self) -> int:
        assert self.row.frames is not None
        return self.row.frames[self._position]

    def _see(self) -> Observation:
        recording, frame = self._recording, self._frame
        by_feature = recording.reader.pictures(self.row.columns["source_episode"], frame, recording.features)
        pictures = {camera: by_feature[feature] for camera, feature in recording.settings.cameras}
        for camera, degrees in recording.settings.rotations:
            pictures[camera] = np.ascontiguousarray(np.rot90(pictures[camera], degrees // 90))
        state = NO_STATE
        if STATE in self._numbers:
            state = self._numbers[STATE][frame].astype(np.float32)
            self._keep("state", state)
        if recording.folder.columns:
            self._keep("columns", [self._numbers[name][frame, 0] for name in recording.folder.columns])
        self._keep_pictures(list(pictures.values()), recording.settings.pixels)
        return observation_of(pictures, state, self.row.instruction, recording.intrinsics)


def _features_text(features: Pairs) -> str:
    return "; ".join(f"{name} from {feature}" for name, feature in features)


def mapped_cameras(
    typed: Pairs, model: Sequence[str], recorded: Sequence[str], renames: Mapping[str, str] = MappingProxyType({})
) -> Pairs:
    """Return pairs of a camera of the model and a feature of the data set, in the model's order.

    Args:
        typed: The pairs as the user mapped them; empty for those of the checkpoint's own map, equal names, or the
            only one of either.
        model: The cameras of the model, the first one in front.
        recorded: The features of the data set that are pictures.
        renames: The model's name of a feature by that of the data set, as the checkpoint's files say.

    Raises:
        RecordingError: For a camera or feature that does not exist. Also if the model's first camera gets no
            picture, and if the checkpoint's map gives two pictures to one camera.
    """
    both = f"the model has {', '.join(model) or 'none'}; the data set has {', '.join(recorded) or 'none'}"
    by_name = renamed_features(recorded, renames)
    if renames:
        both += f"; the checkpoint's rename map says {map_text(renames)}"
    example = by_name.get(f"{IMAGES}{model[0]}" if model else "", recorded) or [f"{IMAGES}top"]
    how = f"Map them, such as --camera {model[0] if model else 'base'}={example[0]}"
    for camera, feature in typed:
        if camera not in model:
            raise RecordingError(f"--camera {camera}=…: the model has no such camera ({both}). {how}")
        if feature not in recorded:
            raise RecordingError(f"--camera {camera}={feature}: the data set has no such picture ({both}). {how}")
    pairs = dict(typed)
    if not typed:
        names = {name.removeprefix(IMAGES): features for name, features in by_name.items()}
        if several := [camera for camera in model if len(names.get(camera, ())) > 1]:
            raise RecordingError(
                f"the checkpoint's rename map gives {' and '.join(names[several[0]])} to the camera {several[0]} "
                f"({both}). {how}"
            )
        pairs = {camera: names[camera][0] for camera in model if camera in names}
        if not pairs and len(model) == len(recorded) == 1:
            pairs = {model[0]: recorded[0]}
    if not pairs or model[0] not in pairs:
        raise RecordingError(f"no picture is mapped to the model's first camera: {both}. {how}")
    return tuple((camera, pairs[camera]) for camera in model if camera in pairs)


def observation_of(
    pictures: Mapping[str, NDArray[np.uint8]],
    state: NDArray[np.float32],
    instruction: str,
    intrinsics: NDArray[np.float32] | None = None,
) -> Observation:
    """Return the observation of pictures by camera, the first of which is the main one and has the intrinsics."""
    first, *other_cameras = pictures
    cameras = {name: pictures[name] for name in other_cameras}
    return Observation(pictures[first], state, instruction, intrinsics, cameras)


def _ahead(actions: NDArray[np.float64], frame: int, count: int) -> NDArray[np.float32]:
    """Return the recorded actions (count, D) from a frame on; behind the end of the episode they are NaN."""
    ahead = np.full((count, actions.shape[1]), np.nan, np.float32)
    recorded = actions[frame : frame + count]
    ahead[: len(recorded)] = recorded
    return ahead
