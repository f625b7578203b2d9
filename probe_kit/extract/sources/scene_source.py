"""The opened scene: every item of a suite in both layouts, and the player whose arm executes actions."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from hashlib import sha256
from itertools import islice
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit.env import Act2AnswerEnv, Idle, SceneSpec, ScriptedExpert
from probe_kit.env.act2answer import Recorder
from probe_kit.errors import SceneError, UsageError
from probe_kit.extract.sources.player import Answer, Ending, Opens, Player
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.sources.source import FIRST_EPISODES, Played, Source, check_units, compare_states
from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import CAMERA
from probe_kit.runs.layout import CAPTURE_ONLY, FIRST_FRAME
from probe_kit.runs.plan import Row
from probe_kit.runs.small_frames import FILM_HEIGHT, HEIGHT, shrink
from probe_kit.suite import Episode, Suite, default_suite, load_suite
from probe_kit.suite.build import ITEMS, default_folder
from probe_kit.suite.items import Side, Wording, in_words
from probe_kit.suite.sufficiency import Smallest

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.hooks.contract.card import DeclaredInputs


class ScenePlayer(Player):
    """A player of episodes of the scene.

    Args:
        scene: The scene.
        played: The frames to keep, and a script. The script `expert`, `expert-mirrored` or `idle` plays every
            episode to its end at once. None: no frames and no script.
    """

    def __init__(self, scene: SceneSpec, played: Played | None = None) -> None:
        self._played = played or Played()
        self._env, self._intrinsics = Act2AnswerEnv(scene), scene.intrinsics

    def begin(self, row: Row, film: bool) -> Answer:
        """Set up an episode and show its first frame, or let the script play it to its end."""
        self._film, self._frames, self.row = film, list[NDArray[np.uint8]](), row
        self._set_up(row)
        self._recorder = Recorder(self._env)
        self._shoot()
        return self._see() if self._played.script is None else self._follow_script()

    def look(self, row: Row) -> tuple[Observation, dict[str, Any]]:
        """Set up an episode and show its first frame, in which nothing moves, with what a run records of it."""
        answer = self.answer("begin", (row, False))
        assert isinstance(answer, Observation)
        return answer, self._facts

    def look_swapped(self) -> tuple[Observation, dict[str, Any]]:
        """Show the item's other layout in the state that this episode is in, with its hash."""
        observation, frame = self._env.observe_exchanged()
        return self._observe(observation), {FIRST_FRAME: frame_sha256(frame)}

    def _set_up(self, row: Row) -> None:
        options = {"item": row.content.item, "layout": row.content.layout}
        _, start = self._env.reset(seed=row.columns["scene_seed"], options=options)
        frame = self._env.render()
        self._facts = {
            FIRST_FRAME: frame_sha256(frame),
            **{f"visible_{side}": share for side, share in start["tile_visibility"].items()},
        }
        self._small_frames: list[NDArray[np.uint8]] = []
        self._keep_small()

    def advance(self, actions: Iterable[NDArray[np.float32]]) -> Answer:
        """Execute actions until they or the episode end."""
        return self._carry_out(actions) or self._see()

    def dismiss(self) -> Ending:
        """End the episode without an action: its model was only captured. There is no outcome."""
        return Ending({"outcome": CAPTURE_ONLY, **self._facts}, self._frames, tuple(self._small_frames))

    def play_again(
        self, row: Row, actions: NDArray[np.float32], execute: int
    ) -> Iterator[tuple[Observation, str]]:
        """Set up an episode and execute stored actions.

        Args:
            row: The row of the episode.
            actions: (T, 7) the actions that were commanded.
            execute: The number of actions that were executed per inference.

        Yields:
            What was to be seen before each action, bit for bit where the policy inferred, and the hash of the
            first frame.
        """
        observation, facts = self.look(row)
        for step, action in enumerate(actions):
            if step:
                inference, is_between = divmod(step, execute)
                observation = self._observe(self._env.observe(None if is_between else inference))
            yield observation, str(facts[FIRST_FRAME])
            self._env.advance(action)

    def tile_masks(self) -> dict[Side, NDArray[np.bool_]]:
        """Return masks (H, W) of where each tile's own picture is visible in the last picture."""
        return self._env.tile_masks()

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def _follow_script(self) -> Ending:
        mirrored = self._played.script == "expert-mirrored"
        script = Idle(self._env) if self._played.script == "idle" else ScriptedExpert(self._env, mirrored)
        script.reset()
        ending = None
        while ending is None:
            ending = self._carry_out([script.act()])
        return ending

    def _carry_out(self, actions: Iterable[NDArray[np.float32]]) -> Ending | None:
        for action in actions:
            if self._played.frames == "all" and self._env.trial.steps == len(self._small_frames):
                self._keep_small()  # before the action, when the picture of an inference exists
            _, terminated, truncated, _ = self._env.advance(action)
            self._recorder.note(action)
            self._shoot()
            if terminated or truncated:
                self._keep_small()
                trajectory = self._recorder.trajectory().frames
                outcome = {**_record(self._env), **self._facts}
                return Ending(outcome, self._frames, tuple(self._small_frames), trajectory)
        return None

    def _keep_small(self) -> None:
        if self._played.frames == "all":
            self._small_frames.append(self._env.render_small(FILM_HEIGHT))
        elif self._played.frames != "none":
            # No model sees the last frame: drawn with a quarter of the pixels, it looks the same in small.
            self._small_frames.append(shrink(self._env.render_small(2 * HEIGHT)))

    def _see(self) -> Observation:
        return self._observe(self._env.observe())

    def _observe(self, observation: Mapping[str, Any]) -> Observation:
        instruction = self.row.content.item.instruction
        return Observation(observation["pixels"]["image"], observation["agent_pos"], instruction, self._intrinsics)

    def _shoot(self) -> None:
        if self._film:
            self._frames.append(self._env.render())


def frame_sha256(frame: NDArray[np.uint8]) -> str:
    """Return the hex sha256 of a frame (H, W, 3) as rendered, of its shape and every byte.

    The frame is not yet resized for a model.
    """
    return sha256(f"{frame.shape}".encode() + np.ascontiguousarray(frame).tobytes()).hexdigest()


def _record(env: Act2AnswerEnv) -> dict[str, Any]:
    """Return the outcome as flat columns, without those that the plan already has."""
    outcome = env.outcome().to_json()
    x, y = outcome.pop("cube_xy")
    return {
        "outcome": outcome.pop("zone"),
        "cube_x": x,
        "cube_y": y,
        **{key: value for key, value in outcome.items() if key not in ("layout", "side_correct")},
    }


EPISODES = 3
"""The number of episodes that are tried if the scene of one cannot be built: a single one costs no run."""


class SceneSource(Source[SceneSettings]):
    """Questions of a suite in a scene.

    Attributes:
        suite: The suite with the chosen categories and items.
    """

    own_units = False
    suite: Suite

    def __init__(self, settings: SceneSettings, suite: Suite) -> None:
        self.settings, self.suite = settings, suite

    @classmethod
    def open(cls, settings: SceneSettings, selects_only: bool) -> Self:
        """Return the suite of some settings with its chosen items; with `selects_only` its first items suffice."""
        categories, count = settings.categories, settings.items
        if settings.suite is not None:
            return cls(settings, load_suite(settings.suite).select(categories, count))
        # Of a category drawn alone every item is the same: drawing all eleven takes minutes.
        if selects_only and count is not None and not default_folder(categories).is_dir():
            return cls(settings, _first_items(categories, count))
        return cls(settings, default_suite(categories).select(None, count))

    @property
    def name(self) -> str:
        """The name, version and hash of the suite."""
        return self.suite.identity

    @cached_property
    def instructions(self) -> tuple[str, ...]:
        """The instructions, each once, in alphabetical order."""
        return tuple(sorted({episode.item.instruction for episode in self._episodes()}))

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return every episode in order, with its seeds, in each wording that its item has.

        Both layouts of an item start from the same scene, and all wordings of an episode from the same seeds.

        Raises:
            UsageError: For a wording that no item has.
            SuiteError: If an item's own words for a wording are empty or unusable.
        """
        # Of the items themselves: an episode in another wording holds its item with that wording as instruction.
        content = {item.item_id: item.content_sha256 for item in self.suite.items}
        rows = tuple(
            scene_row(
                index, episode, derive_seed(seed, "scene", episode.item.item_id),
                derive_seed(seed, "policy", episode.seed_id), content[episode.item.item_id],
            )
            for index, episode in enumerate(self._episodes())
        )  # fmt: skip
        self._count_skipped(rows)
        return rows

    def _episodes(self) -> Iterator[Episode]:
        wordings = self.settings.wordings
        for episode in self.suite.episodes():
            yield from filter(
                None, [episode] if wordings is None else (in_words(episode, wording) for wording in wordings)
            )

    def _count_skipped(self, rows: Sequence[Row]) -> dict[Wording, int]:
        """Count the items that lack a wording, by wording. Raises UsageError for a wording that no item has."""
        skipped = {}
        for wording in self.settings.wordings or ():
            items = {row.columns["item_id"] for row in rows if row.columns.get("wording") == wording}
            if not items:
                raise UsageError(
                    f"no item of {self.suite.identity} has the wording {wording!r}. Leave it out of --wordings, "
                    "or write it into the suite's metadata (field `wordings`)"
                )
            skipped[wording] = len(self.suite.items) - len(items)
        return skipped

    # -- what a run says of it -----------------------------------------------------------------------

    def known_early(self) -> dict[str, Any]:
        """Return the suite and the scene, which no model decides."""
        return self.identity(0)

    def identity(self, execute: int) -> dict[str, Any]:
        """Return name and version of the suite, and the scene; items are compared one by one, by their content."""
        del execute
        suite = {"name": self.suite.name, "version": self.suite.version}
        return {"suite": suite, "scene": self.settings.scene.to_json()}

    def name_parts(self) -> list[Any]:
        """Return the whole suite, the selected categories, and the wordings."""
        return [self.suite.complete.content_sha256, self.suite.categories, self.settings.wordings]

    @property
    def suite_parent(self) -> Any:
        """The hash of the suite that this one was selected from."""
        return self.suite.parent

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the selected part of the suite, and the texts of wordings."""
        suite = self.suite
        selected: dict[str, Any] = {
            "suite": {
                "identity": suite.identity,
                "content_sha256": suite.content_sha256,
                "seed_text": suite.seed_text,
            },
            "categories": list(suite.categories),
            "items": len(suite.items),
        }
        if self.settings.wordings is not None:
            texts, skipped = [[row.episode_id, row.instruction] for row in rows], self._count_skipped(rows)
            selected["wordings"] = {
                "names": list(skipped),
                "skipped": skipped,
                "texts_sha256": sha256_json(texts),
            }
        return selected

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return suite, categories, scene, episodes and wordings."""
        scene, skipped = self.settings.scene, self._count_skipped(rows)
        early = ", less once the cube was released and rests" if scene.early_stop else ""
        wordings = ", ".join(
            f"{name} ({count} items have none: skipped)" if count else name for name, count in skipped.items()
        )
        return {
            "suite": self.suite.identity,
            "categories": ", ".join(self.suite.categories),
            "scene": f"{scene.name}, at most {scene.max_steps} actions{early}",
            "episodes": f"{len(rows)} ({plural(len(self.suite.items), 'item')} in both layouts)",
            **({"wordings": wordings} if skipped else {}),
        }

    def targets(self) -> tuple[str, ...]:
        """Return the sides of the correct and of the chosen picture."""
        return ("side.correct", "side.chosen")

    # -- what a model sees ---------------------------------------------------------------------------

    def example(self, instruction: str) -> Observation:
        """Return a blank picture of the scene's size."""
        scene = self.settings.scene
        blank, state = np.zeros((*scene.picture_shape, 3), np.uint8), np.zeros(8, np.float32)
        return Observation(blank, state, instruction, scene.intrinsics)

    def shown_cameras(self, declared: "DeclaredInputs | None" = None) -> tuple[str, ...]:
        """Return the first camera: the scene has one."""
        return (declared.cameras if declared else (CAMERA,))[:1]

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Raise UnitsError for a scene whose first states do not fit the statistics of a policy."""
        if policy.state_numbers is None or "state" in policy.zero_filled_inputs():
            return self, policy
        states = policy.laid_out(self._first_states())
        names = [str(number) for number in range(states.shape[1])]
        self.units = compare_states(policy, [states], names, begins=True)
        check_units(self.units, f"the scene {self.settings.scene.name}", policy, accept_units)
        return self, policy

    def _first_states(self) -> Any:
        """Return states (n, 8) of the arm at the first inference of some rows, as far as they can be set up.

        Raises:
            SceneError: If none can be set up.
        """
        states, failed = [], None
        player = ScenePlayer(self.settings.scene)
        try:
            for row in self.rows(0)[:FIRST_EPISODES]:
                try:
                    states.append(player.look(row)[0].state)
                except SceneError as error:
                    failed = error
        finally:
            player.close()
        if not states and failed is not None:
            raise failed
        return np.stack(states)

    def rehearse(self, rows: Iterable[Row]) -> None:
        """Set up the first row, or the next ones if its start cannot be reached.

        Raises:
            SceneError: If none of the first rows can be set up, such as for an arm whose meshes are not installed.
            SuiteError: If a picture of the first one is not what the suite says.
        """
        env, failed = Act2AnswerEnv(self.settings.scene), None
        try:
            for row in islice(rows, EPISODES):
                try:
                    options = {"item": row.content.item, "layout": row.content.layout}
                    env.reset(seed=row.columns["scene_seed"], options=options)
                except SceneError as error:
                    failed = error
                else:
                    return
        finally:
            env.close()
        if failed is not None:
            raise failed

    def play(self, played: Played) -> Opens:
        """Open a player of the scene."""
        return partial(ScenePlayer, self.settings.scene, played)


def _first_items(categories: Sequence[str] | None, count: int) -> Suite:
    """Return the first items of the embedded suite, drawn alone: fewer items are the beginning of more.

    They are marked as selected from the category that a plan looks at for further items, which is drawn in full.
    """
    drawn = min(max(2, count + count % 2), ITEMS)
    suite = default_suite(categories, drawn).select(None, count)
    return replace(suite, selected_from=default_suite((Smallest.of(suite).category,)))


def scene_row(
    index: int, episode: Episode, scene_seed: int, policy_seed: int, content_sha256: str | None = None
) -> Row:
    """Return the row of an episode; `content_sha256` is the hash of its item, None outside a plan."""
    item, wording = episode.item, episode.wording
    columns: Mapping[str, Any] = {
        "episode_id": episode.episode_id,
        "item_id": item.item_id,
        "category": item.category,
        "group_id": item.group_id,
        "pair_id": item.pair_id,
        "layout": episode.layout,
        "side_correct": episode.side_correct,
        "instruction": item.instruction,
        "target_concept": item.target_concept,
        "distractor_concept": item.distractor_concept,
        "scene_seed": scene_seed,
        "policy_seed": policy_seed,
        **({} if wording is None else {"wording": wording}),
        **({} if content_sha256 is None else {"item_content_sha256": content_sha256}),
    }
    return Row(index, columns, episode)
