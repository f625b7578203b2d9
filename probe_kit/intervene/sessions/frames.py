"""Frames of a run without sides, shown again by its own source: recorded ones, first observations, pictures."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.extract.sources.inputs import INSTRUCTION, PICTURE, STATE, Frame
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.sessions.session import ReplaySource
from probe_kit.runs import Run
from probe_kit.runs.layout import stored_inputs_of

CACHED = 256
"""Observations that are kept: those of the nearest frames are compared again and again."""
_CONTENT = "content_blake2b"


class Frames:
    """All frames of a run that can be shown again: of each row those that its source gives without an action.

    cameras: of the policy, those that get a picture. index: the frames, in the order of rows and inferences.
    """

    def __init__(self, run: Run, source: ReplaySource) -> None:
        """Raises UsageError if files of the source are gone, OtherFramesError for another version of it."""
        from probe_kit.extract.config_files import source_again
        from probe_kit.extract.sources.source import Played

        self.run, inputs = run, stored_inputs_of(run.settings)
        opened = source_again(run, source.moved).open()
        opened.check_same(run.settings)
        opened.columns = tuple(inputs["columns"])
        self._name, self._rows = opened.name, {row.episode_id: row for row in opened.rows(run.settings["seed"])}
        self._player = opened.play(Played())()
        self.cameras = tuple(camera if isinstance(camera, str) else camera[0] for camera in inputs["cameras"])
        self._cached = lru_cache(maxsize=CACHED)(self.observe)
        self.index = list(self._listed())

    @cached_property
    def by_name(self) -> dict[tuple[str, int], Frame]:
        """The frames by number and episode, or item: a table of pairs may name either."""
        names = {(frame.item, frame.number): frame for frame in self.index}
        return names | {(frame.episode, frame.number): frame for frame in self.index}

    def check_varied(self, vary: str) -> None:
        """Raise UsageError for an input that the frames do not have, such as a mistyped camera."""
        inputs = (INSTRUCTION, PICTURE, *(f"{PICTURE}.{name}" for name in self.cameras), STATE)
        if vary not in inputs:
            raise UsageError(f"vary is {vary!r}; expected one of {', '.join(inputs)}")

    def observe(self, frame: Frame) -> Observation:
        """Show a frame. Raises OtherFramesError if it is not the run's."""
        row = self._rows[frame.episode]
        stored = self.run.episodes.iloc[frame.row].get(_CONTENT)
        if stored != row.columns.get(_CONTENT):
            raise OtherFramesError(
                f"{self._name}: the files of {frame.item} are not those of {self.run.location}: their hash "
                "differs. Give the files of the run"
            )
        single = row if row.frames is None else replace(row, frames=(frame.number,))
        observation = self._player.answer("begin", (single, False))
        assert isinstance(observation, Observation)
        if frame.state.size and not np.array_equal(observation.state.astype(np.float64), frame.state):
            raise OtherFramesError(
                f"{self._name}, {frame.episode}: the state at the beginning is not that of {self.run.location}. "
                "Take all randomness from the episode's seed, and use the run's version"
            )
        pictures = {name: np.array(picture) for name, picture in observation.cameras.items()}
        return replace(
            observation, image=np.array(observation.image), state=np.array(observation.state), cameras=pictures
        )

    def close(self) -> None:
        """Free what the player holds."""
        self._player.close()

    def _listed(self) -> Iterator[Frame]:
        inputs = self.run.inputs
        assert inputs is not None
        states = inputs.read("state").astype(np.float64) if "state" in inputs.kinds else None
        kind = next((name for name in ("prediction", "action") if name in inputs.kinds), None)
        actions = None if kind is None else inputs.read(kind)
        for row, record in enumerate(self.run.episodes.to_dict("records")):
            planned = self._rows.get(str(record["episode_id"]))
            if planned is None:
                raise OtherFramesError(
                    f"{self._name} has no episode {record['episode_id']!r} any more; use the run's version"
                )
            for call, number in enumerate((0,) if planned.frames is None else planned.frames):
                yield Frame(
                    name=f"{record['episode_id']}@{number}",
                    group=str(record["group_id"]),
                    seed=derive_seed(int(record["policy_seed"]), "inference", number),
                    instruction=str(record["instruction"]),
                    state=np.zeros(0) if states is None else states[row, call],
                    observe=self._cached,
                    row=row,
                    number=number,
                    item=str(record["item_id"]),
                    episode=str(record["episode_id"]),
                    category=str(record["category"]),
                    stored=None if actions is None else np.asarray(actions[row, call], np.float32),
                )
