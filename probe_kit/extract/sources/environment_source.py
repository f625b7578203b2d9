"""Opened environments of the user's own: chosen episodes, and the player that plays them.

Every error of an environment's code becomes an OwnEnvironmentError.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from inspect import signature
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import describe_range, plural
from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.imports import entry_points
from probe_kit.errors import (
    CheckpointError,
    ObservationError,
    OtherFramesError,
    OwnEnvironmentError,
    ProbeKitError,
    UsageError,
)
from probe_kit.extract.sources.environment import (
    LEROBOT,
    MOST_STEPS,
    SUCCESS,
    EnvEpisode,
    EnvironmentSettings,
    OwnEnvironment,
    Step,
)
from probe_kit.extract.sources.environment_starts import compare_steps, start_digest
from probe_kit.extract.sources.player import SIDE, Answer, Ending, InputsPlayer, Opens, frames_of_episode
from probe_kit.extract.sources.recording import EVERY_CAMERA, Pairs, degrees_of
from probe_kit.extract.sources.source import (
    FIRST_EPISODES,
    Played,
    Source,
    check_units,
    compare_states,
    exchanged_names,
    predicted_once,
)
from probe_kit.extract.sources.step_limits import checked_limit, declared_limit
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.card import DeclaredInputs
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.families.shared.kinds import IMAGES, map_text, renamed_features
from probe_kit.runs.input_content import EpisodeFrames, content_notes
from probe_kit.runs.layout import AT_END, ENVIRONMENT, LIMIT, ONCE, START, TRUTHS
from probe_kit.runs.plan import Row
from probe_kit.runs.small_frames import SmallFrames, shrink

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


ENTRY_POINTS = "probe_kit.environments"
METHODS = ("episodes", "reset", "step", "close")
MOST_EPISODES = 1_000_000
LONGEST = 200
"""The most characters of an episode's id or group."""


@contextmanager
def naming_environment(name: str, doing: str, remedy: Callable[[], str] | None = None) -> Iterator[None]:
    """Replace errors of an environment's code in the body by OwnEnvironmentError; those of probe_kit stay.

    Args:
        name: The environment as the user named it.
        doing: The method that is called.
        remedy: Returns what the user can do; by default it is to correct the environment, or for one of lerobot's
            to check its simulator.
    """
    try:
        yield
    except ProbeKitError:
        raise
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {str(error)[:500].rstrip('.')}"
        usual = "Correct the environment"
        if name.startswith(f"{LEROBOT}:"):
            usual = "Check the simulator's installation and files, or give other options (--env-option)"
        advice = usual if remedy is None else remedy()
        raise OwnEnvironmentError(f"{name} failed in {doing}: {reason}. {advice}") from error


def factory_of(name: str) -> Callable[..., Any]:
    """Return the class or function that `name` leads to.

    Raises:
        UsageError: If there is no such module, class or entry point.
        OwnEnvironmentError: For an import that fails.
    """
    module, colon, attribute = name.partition(":")
    if module == LEROBOT and colon:
        from probe_kit.extract.sources.lerobot_env import LeRobotEnvironment

        return partial(LeRobotEnvironment, attribute)
    if not colon:
        installed = {entry_point.name: entry_point for entry_point in entry_points(group=ENTRY_POINTS)}
        if name not in installed:
            raise UsageError(
                f"--env {name!r}: expected MODULE:CLASS such as kitchen:Kitchen, lerobot:TYPE, or an installed "
                f"entry point ({', '.join(sorted(installed)) or 'there is none'})"
            )
        with naming_environment(name, "its import"):
            loaded: Callable[..., Any] = installed[name].load()
        return loaded
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.append(folder)  # a command does not have it; behind all others, so that it hides nothing
    try:
        with naming_environment(name, "its import"):
            opened = import_module(module)
    except OwnEnvironmentError as error:
        if isinstance(error.__cause__, ModuleNotFoundError) and error.__cause__.name == module.split(".")[0]:
            raise UsageError(
                f"--env {name}: there is no module {module}; expected {module}.py in this folder, or an "
                "installed module"
            ) from error
        raise
    factory = getattr(opened, attribute, None)
    if not callable(factory):
        raise UsageError(f"--env {name}: {module} has no class {attribute!r}")
    typed_factory: Callable[..., Any] = factory
    return typed_factory


def open_environment(source: EnvironmentSettings) -> OwnEnvironment:
    """Open a new environment. Raises OwnEnvironmentError if it breaks its contract, and as `factory_of`."""
    factory = factory_of(source.environment)
    with naming_environment(source.environment, "its constructor", partial(_options_of, factory)):
        environment: OwnEnvironment = factory(**dict(source.options))
    check_members(environment, source.environment)
    pictures = dict(source.cameras)
    turns = [(pictures.get(camera, camera), degrees) for camera, degrees in source.rotations]
    return RotatedEnvironment(environment, turns) if turns else environment


def _options_of(factory: Callable[..., Any]) -> str:
    """Return what the user can do where a class cannot be made: its options with their defaults, if it has any."""
    try:
        parameters = [str(parameter) for parameter in signature(factory).parameters.values()]
    except (TypeError, ValueError):  # of a class that is no Python code
        parameters = []
    options = f"Its options are {', '.join(parameters)}: give" if parameters else "It takes no options: give none"
    return f"{options} with --env-option NAME=VALUE, or correct the environment"


class RotatedEnvironment:
    """An environment whose pictures are rotated, as its user asked for.

    Args:
        environment: The environment, all of whose other parts stay as they are.
        rotations: Pairs of a picture's name and degrees, counterclockwise. `*` is every picture, and a name that
            `Observation.cameras` lacks the first picture.
    """

    def __init__(self, environment: OwnEnvironment, rotations: Sequence[tuple[str, int]]) -> None:
        self._environment, self._rotations = environment, tuple(rotations)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._environment, name)

    @property
    def max_steps(self) -> int | None:
        """The limit that the environment or its simulator declares."""
        return declared_limit(self._environment, type(self._environment).__name__)

    def reset(self, episode: EnvEpisode) -> Observation | Step:
        """Set an episode up, and return its beginning with rotated pictures."""
        answer = self._environment.reset(episode)
        return self._rotate(answer) if isinstance(answer, Observation) else self._rotated_step(answer)

    def step(self, action: NDArray[np.float32]) -> Step:
        """Execute one action, and return the state after it with rotated pictures."""
        return self._rotated_step(self._environment.step(action))

    def _rotated_step(self, step: Step) -> Step:
        is_step = isinstance(step, Step) and isinstance(step.observation, Observation)
        return replace(step, observation=self._rotate(step.observation)) if is_step else step

    def _rotate(self, observation: Observation) -> Observation:
        further_cameras = observation.cameras
        first = next(
            (camera for camera, _ in self._rotations if camera not in (*further_cameras, EVERY_CAMERA)), ""
        )
        cameras = {
            name: _rotate_picture(picture, degrees_of(self._rotations, name))
            for name, picture in further_cameras.items()
        }
        image = _rotate_picture(observation.image, degrees_of(self._rotations, first))
        return replace(observation, image=image, cameras=cameras)


def _rotate_picture(picture: NDArray[np.uint8], degrees: int) -> NDArray[np.uint8]:
    """Return a picture that is rotated counterclockwise; what is no picture stays, and is refused later."""
    if not (isinstance(picture, np.ndarray) and picture.ndim == 3):
        return picture
    return np.ascontiguousarray(np.rot90(picture, degrees // 90))


def check_members(environment: object, name: str) -> None:
    """Raise OwnEnvironmentError unless the environment has revision, names of actions and all methods."""
    missing = [method for method in METHODS if not callable(getattr(environment, method, None))]
    if missing:
        raise OwnEnvironmentError(f"{name} has no method {missing[0]!r}; expected {', '.join(METHODS)}")
    revision = getattr(environment, "revision", None)
    if not isinstance(revision, str) or not revision.strip() or UNSAFE.search(revision):
        raise OwnEnvironmentError(
            f"{name} has the revision {revision!r}; expected a text that changes with its numbers, such as "
            "'kitchen 1.2, mujoco 3.3'"
        )
    names = getattr(environment, "action_names", None)
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or len(set(names)) < len(names):
        raise OwnEnvironmentError(
            f"{name} has the action_names {names!r}; expected a name for each number of an action, each once"
        )


def listed_episodes(environment: OwnEnvironment, source: EnvironmentSettings) -> list[tuple[int, EnvEpisode]]:
    """Return the chosen episodes with their indices. Raises OwnEnvironmentError for equal ids."""
    indices = source.episodes
    most = MOST_EPISODES if indices is None else indices[-1] + 1
    with naming_environment(source.name, "episodes()"):
        episodes = list(islice(environment.episodes(), most + (indices is None)))
    if len(episodes) > MOST_EPISODES:
        raise OwnEnvironmentError(
            f"{source.name} has more than {MOST_EPISODES:,} episodes; choose with --episodes"
        )
    for number, episode in enumerate(episodes):
        _check_episode(episode, f"{source.name}, episode {number}")
    ids = [episode.id for episode in episodes]
    if len(set(ids)) < len(ids):
        twice = next(episode_id for episode_id in ids if ids.count(episode_id) > 1)
        raise OwnEnvironmentError(f"{source.name} has two episodes of the id {twice!r}; expected each once")
    if indices is not None and indices[-1] >= len(episodes):
        raise UsageError(
            f"{source.name} has {len(episodes)} episodes, counted from 0; asked for {indices[-1]}. Give episodes "
            f"within 0:{len(episodes)}"
        )
    if not episodes:
        raise OwnEnvironmentError(f"{source.name} has no episode; expected at least one")
    return [(number, episodes[number]) for number in (range(len(episodes)) if indices is None else indices)]


def _check_episode(episode: object, where: str) -> None:
    if not isinstance(episode, EnvEpisode):
        raise OwnEnvironmentError(f"{where} is a {type(episode).__name__}; expected an EnvEpisode")
    texts = {"id": episode.id, "instruction": episode.instruction, "group": episode.group or episode.id}
    for name, text in texts.items():
        if not isinstance(text, str) or not text.strip() or UNSAFE.search(text):
            raise OwnEnvironmentError(f"{where} has the {name} {text!r}; expected plain text")
    if len(episode.id) > LONGEST or len(texts["group"]) > LONGEST:
        raise OwnEnvironmentError(f"{where} has an id or group of more than {LONGEST} characters; shorten it")
    if isinstance(episode.seed, bool) or not isinstance(episode.seed, int) or episode.seed < 0:
        raise OwnEnvironmentError(f"{where} has the seed {episode.seed!r}; expected a whole number from 0 on")
    if episode.max_steps is not None:
        checked_limit(episode.max_steps, where)


def start_episode(environment: OwnEnvironment, episode: EnvEpisode, where: str) -> Step:
    """Return the beginning of an episode, as `checked_step` returns it. Raises OwnEnvironmentError."""
    with naming_environment(where, "reset()"):
        answer = environment.reset(episode)
    step = checked_step(Step(answer) if isinstance(answer, Observation) else answer, episode, f"{where}, reset()")
    if step.done:
        raise OwnEnvironmentError(f"{where}, reset() says that the episode is over; expected done=False")
    return step


def checked_step(answer: object, episode: EnvEpisode, where: str) -> Step:
    """Return a step with pictures, state and facts as the contract requires them, in copies of its own.

    An environment may write into its arrays afterwards.

    Raises:
        OwnEnvironmentError: For a step that breaks the contract.
    """
    if not isinstance(answer, Step) or not isinstance(answer.observation, Observation):
        kind = type(answer.observation if isinstance(answer, Step) else answer).__name__
        raise OwnEnvironmentError(f"{where} gave a {kind}; expected a Step with an Observation")
    seen_now = answer.observation
    try:
        for picture in (seen_now.image, *seen_now.cameras.values()):
            checked_picture(np.asarray(picture))
    except ObservationError as error:
        raise OwnEnvironmentError(f"{where}: {error}") from None
    state = seen_now.state
    if not isinstance(state, np.ndarray) or state.dtype != np.float32 or state.ndim != 1:
        is_array = isinstance(state, np.ndarray)
        described = f"{state.dtype} {state.shape}" if is_array else type(state).__name__
        raise OwnEnvironmentError(f"{where}: the state is {described}; expected float32 (D,)")
    if not np.isfinite(state).all():
        raise OwnEnvironmentError(f"{where}: the state holds NaN or infinity; expected finite numbers")
    if seen_now.instruction != episode.instruction:
        raise OwnEnvironmentError(
            f"{where}: the observation has the instruction {seen_now.instruction!r}, the episode "
            f"{episode.instruction!r}; expected the same"
        )
    for name, value in answer.facts.items():
        number = isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating)
        if not isinstance(name, str) or not name.strip() or UNSAFE.search(name):
            raise OwnEnvironmentError(f"{where}: a fact has the name {name!r}; expected plain text")
        if not number or not np.isfinite(float(value)):
            raise OwnEnvironmentError(
                f"{where}: the fact {name!r} is {value!r}; expected a finite number or a truth value"
            )
        if name == SUCCESS and value not in (0, 1):
            raise OwnEnvironmentError(
                f"{where}: the fact {SUCCESS!r} is {value!r}; expected a truth value: True, False, 1 or 0. Give "
                "a part or a score another name"
            )
    return _copy_step(answer)


def _copy_step(step: Step) -> Step:
    observation = step.observation
    cameras = {name: np.array(picture) for name, picture in observation.cameras.items()}
    lens = None if observation.intrinsics is None else np.array(observation.intrinsics)
    copy = replace(
        observation,
        image=np.array(observation.image),
        state=np.array(observation.state),
        intrinsics=lens,
        cameras=cameras,
    )
    return Step(copy, bool(step.done), dict(step.facts))


def fact_values(facts: Mapping[str, Any], names: Sequence[str], where: str) -> list[float]:
    """Return the values of facts in the order of their names. Raises OwnEnvironmentError for other names."""
    if sorted(facts) != sorted(names):
        raise OwnEnvironmentError(
            f"{where} has the facts {sorted(facts)}; expected {sorted(names)}, the same at every step"
        )
    return [float(facts[name]) for name in names]


# -- pictures by camera ------------------------------------------------------------------------------------------


def first_picture(environment: OwnEnvironment) -> str:
    """Return the name of `Observation.image`: as the environment has it, else `image`."""
    return str(getattr(environment, "first_camera", "image"))


def mapped_pictures(
    typed: Pairs, inputs: DeclaredInputs, pictures: Sequence[str], by_name: bool, where: str
) -> Pairs:
    """Return pairs of a camera of the model and a picture of the environment; none where the contract's are right.

    Args:
        typed: The pairs as the user mapped them; they count over all else.
        inputs: The model's cameras, and names that its files rename.
        pictures: The environment's pictures, that of `Observation.image` first.
        by_name: Whether the first picture has a name too, so that all are looked up by name.
        where: The environment, for messages.

    Raises:
        OwnEnvironmentError: For a camera or picture that does not exist, and for two pictures of one camera.
    """
    main, *further_cameras = inputs.cameras
    both = f"the model has {', '.join(inputs.cameras)}; the environment shows {', '.join(pictures)}"
    if typed:
        pairs = {camera: name.removeprefix(IMAGES) for camera, name in typed}
        if strange := [(camera, name) for camera, name in pairs.items() if name not in pictures]:
            camera, name = strange[0]
            raise OwnEnvironmentError(f"{where}: --camera {camera}={name}: there is no such picture ({both})")
        if strange := [(camera, name) for camera, name in pairs.items() if camera not in inputs.cameras]:
            camera, name = strange[0]
            raise OwnEnvironmentError(f"{where}: --camera {camera}={name}: there is no such camera ({both})")
    elif by_name:
        pairs = _pairs_by_name(inputs, pictures, f"{where}: {{}} ({both})")
        if main not in pairs:
            return ()
    else:
        # By the contract its names are the model's: only one that the model lacks is looked up.
        renamed = {name: inputs.renames.get(full_name(name), "").removeprefix(IMAGES) for name in pictures[1:]}
        pairs = {renamed[name] or name: name for name in pictures[1:] if name not in further_cameras}
        if not set(pairs) <= set(further_cameras) or not pairs:
            return ()
        pairs |= {main: pictures[0], **{name: name for name in pictures[1:] if name in further_cameras}}
    if main not in pairs:
        raise OwnEnvironmentError(
            f"{where}: the model's first camera gets no picture ({both}). Map it, such as --camera "
            f"{main}={pictures[0]}"
        )
    mapped = tuple((camera, pairs[camera]) for camera in inputs.cameras if camera in pairs)
    by_contract = ((main, pictures[0]), *((name, name) for name in pictures[1:]))
    return () if mapped == by_contract and not typed else mapped


def _pairs_by_name(inputs: DeclaredInputs, pictures: Sequence[str], sentence: str) -> dict[str, str]:
    """Return the picture of every camera that has one, as lerobot names them after the checkpoint's own map."""
    names = {full_name(picture): picture for picture in pictures}
    sources = renamed_features(names, inputs.renames)
    by_camera = {camera: sources[full_name(camera)] for camera in inputs.cameras if full_name(camera) in sources}
    if several := [camera for camera, features in by_camera.items() if len(features) > 1]:
        camera = several[0]
        problem = f"the checkpoint's rename map gives {' and '.join(by_camera[camera])} to the camera {camera}"
        raise OwnEnvironmentError(f"{sentence.format(problem)}. Choose with --camera {camera}=PICTURE")
    return {camera: names[features[0]] for camera, features in by_camera.items()}


def full_name(picture: str) -> str:
    """Return the name of the feature of a picture, as lerobot has it."""
    return picture if picture.startswith("observation.") else f"{IMAGES}{picture}"


def arrange_pictures(step: Step, pairs: Pairs, first: str, where: str) -> Step:
    """Return a step whose pictures are those of the model's cameras; as it is where there are no pairs.

    Args:
        step: The step as the environment gave it.
        pairs: A camera of the model and the name of its picture, the first camera in front.
        first: The name of `Observation.image`.
        where: The environment, for messages.

    Raises:
        OwnEnvironmentError: For a picture that the environment does not show.
    """
    if not pairs:
        return step
    observation = step.observation
    pictures = {first: observation.image, **observation.cameras}
    if missing := [name for _, name in pairs if name not in pictures]:
        raise OwnEnvironmentError(f"{where} shows {', '.join(pictures)}, and no {missing[0]!r}. Correct --camera")
    (_, main), *further_pairs = pairs
    lens = observation.intrinsics if main == first else None
    cameras = {camera: pictures[name] for camera, name in further_pairs}
    return replace(step, observation=replace(observation, image=pictures[main], intrinsics=lens, cameras=cameras))


CATEGORY = "all"
"""The category of every row: environments have no categories."""
SUCCEEDED, FAILED, ENDED = "success", "failure", "ended"
"""The outcomes: whether the fact `success` is true at the last step; the last one where there is no such fact."""


def limit_in(settings: EnvironmentSettings, episode: EnvEpisode) -> int | None:
    """Return the actions after which the benchmark ends an episode; None where nothing declares a number."""
    return episode.max_steps or settings.limit


def most_steps(settings: EnvironmentSettings, episode: EnvEpisode) -> int:
    """Return the actions after which an episode ends: those that were typed, else the benchmark's."""
    return settings.max_steps or min(episode.max_steps or settings.steps(), MOST_STEPS)


class EnvironmentSource(Source[EnvironmentSettings]):
    """The names and chosen episodes of an environment, read once.

    Attributes:
        seen: The first observation; None before a model is checked.
        cameras: The cameras by the model's names; empty before.
        columns: The facts; empty before.
        truths: The facts that are truth values; empty before.
        chunk: The number of actions that the policy predicts at a time; 0 before.
        starts: The hashes of the first observations of the first episodes; empty before they were set up, and
            where they need not repeat.
        renamed: The checkpoint's own map of names in words; empty before, or where it has none.
    """

    def __init__(
        self, settings: EnvironmentSettings, revision: str, actions: Sequence[str], episodes: Sequence[Any]
    ) -> None:
        """Keep what the environment says; `episodes` has pairs of the index in the environment and the episode."""
        self.settings, self.revision, self.actions = settings, revision, tuple(actions)
        self.episodes: list[tuple[int, EnvEpisode]] = list(episodes)
        self.seen: Observation | None = None
        self.cameras: list[str] = []
        self.truths: list[str] = []
        self.chunk = 0
        self.starts: dict[str, str] = {}
        is_typed = settings.max_steps is not None
        self._has_limits_of_episodes = not is_typed and any(
            episode.max_steps is not None for _, episode in self.episodes
        )
        self._frames: list[EpisodeFrames] = []
        self.renamed = ""

    @classmethod
    def open(cls, settings: EnvironmentSettings, selects_only: bool) -> Self:
        """Open the environment once, list its episodes, and read after how many actions it ends them.

        An environment that declares no limit before its first episode may hold its simulator from then on.

        Raises:
            OwnEnvironmentError: As `open_environment` and `listed_episodes` raise it.
        """
        del selects_only
        environment, name = open_environment(settings), settings.name
        try:
            listed = listed_episodes(environment, settings)
            limits = {episode.max_steps for _, episode in listed} or {None}
            if None in limits:
                limit = declared_limit(environment, name)
                if limit is None:
                    start_episode(environment, listed[0][1], name)
                    limit = declared_limit(environment, name)
                limits = (limits - {None}) | ({limit} if limit is not None else set())
            settings = settings.changed(limit=max((limit for limit in limits if limit is not None), default=None))
            return cls(settings, environment.revision, [str(name) for name in environment.action_names], listed)
        finally:
            environment.close()

    def decided(self) -> dict[str, Any]:
        """Return the settings of the environment, with the limit that it declares."""
        return {"source": self.settings}

    def rehearse(self, rows: "Iterable[Row]") -> None:
        """Set the first episode up twice, with another one in between, before anything is played.

        Raises:
            OwnEnvironmentError: If it starts otherwise the second time, unless that is accepted.
        """
        del rows
        episodes = [episode for _, episode in self.episodes[:2]]
        environment, name = open_environment(self.settings), self.name
        try:
            first, *later_starts = (start_episode(environment, episode, name) for episode in episodes)
            again = start_episode(environment, episodes[0], name)
        finally:
            environment.close()
        if not self.settings.accept_nondeterminism:
            self._check_repeats(first, again)
            self.starts = {
                episode.id: start_digest(step)
                for episode, step in zip(episodes, (first, *later_starts), strict=True)
            }

    def _check_repeats(self, first: Step, again: Step) -> None:
        different, equal = compare_steps(first, again)
        if not different:
            return
        episode, name = self.episodes[0][1], self.name
        environment = open_environment(self.settings)
        try:
            elsewhere = start_episode(environment, episode, name)
        finally:
            environment.close()
        repeats = (
            "The first reset of a new environment does repeat: its constructor and the number of resets decide "
            "the start, not the episode's seed"
            if not compare_steps(first, elsewhere)[0]
            else "The first reset of a new environment does not repeat either"
        )
        raise OwnEnvironmentError(
            f"{name}, episode {episode.id!r}: set up twice with the seed {episode.seed}, it starts otherwise the "
            f"second time: {', '.join(different)}; equal: {', '.join(equal) or 'nothing'}. {repeats}. Take all "
            "randomness from the episode's seed in reset(), or make the simulator anew there; what cannot repeat, "
            "such as a robot, is played with --accept-nondeterminism"
        )

    @property
    def starts_are_equal(self) -> bool:
        """Whether the first two episodes, of different seeds and groups, start with the same observation."""
        episodes = [episode for _, episode in self.episodes[:2]]
        return (
            len(self.starts) > 1
            and len(set(self.starts.values())) == 1
            and len({episode.group or episode.id for episode in episodes}) > 1
        )

    def smaller_groups(self, rows: Sequence[Row]) -> str:
        """Return the option by which each start is a group; empty where seeds are seen to start equally."""
        has_names = any(row.content.group is not None for row in rows)
        same = len(set(self.starts.values())) < len(self.starts)
        return f"train --group-by {START} makes a group of each start" if has_names and not same else ""

    def most_steps(self, episode: EnvEpisode) -> int:
        """Return the number of actions after which an episode ends."""
        return most_steps(self.settings, episode)

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return a row per episode."""
        return tuple(
            Row(
                index,
                {
                    "episode_id": episode.id,
                    "item_id": episode.id,
                    "category": CATEGORY,
                    "group_id": episode.group or episode.id,
                    "instruction": episode.instruction,
                    "env_episode": number,
                    "env_seed": episode.seed,
                    "policy_seed": derive_seed(seed, "policy", episode.id),
                    **({"max_steps": self.most_steps(episode)} if self._has_limits_of_episodes else {}),
                },
                episode,
            )
            for index, (number, episode) in enumerate(self.episodes)
        )

    # -- a model -------------------------------------------------------------------------------------

    def for_cameras(self, cameras: Sequence[str]) -> Self:
        """Set up the first chosen episode; no action is executed, so that facts are those of `reset`."""
        return self._begin(DeclaredInputs(tuple(cameras[:1])), False)

    def _begin(self, inputs: DeclaredInputs, by_name: bool) -> Self:
        typed = self.settings.cameras
        environment = open_environment(self.settings)
        try:
            first = start_episode(environment, self.episodes[0][1], self.name)
            first = self._map_cameras(environment, first, inputs, by_name)
        finally:
            environment.close()
        if self.settings.rotations and self.settings.cameras != typed:
            # Cameras of the model are rotated, and only now it is known which pictures they get.
            return self._begin(inputs, by_name)
        self.seen, self.cameras = first.observation, [*inputs.cameras[:1], *first.observation.cameras]
        self._frames = [frames_of_steps(self.episodes[0][1].id, [first])]
        self._note_facts(first)
        return self

    def content_notes(self) -> tuple[str, ...]:
        """Return a sentence for every camera of one colour or under two names, in the first frames of episodes."""
        names = self.cameras or ["picture"]
        return tuple(content_notes(self._frames, names))

    def _map_cameras(
        self, environment: OwnEnvironment, step: Step, inputs: DeclaredInputs, by_name: bool = True
    ) -> Step:
        """Decide which picture a camera of the model gets, and return the step with its pictures so."""
        pictures = [first_picture(environment), *step.observation.cameras]
        by_name = by_name and hasattr(environment, "first_camera")
        typed = self.settings.cameras
        pairs = mapped_pictures(typed, inputs, pictures, by_name, self.name)
        self.renamed = self._describe_renames(inputs, pictures)
        self.settings = self.settings.changed(cameras=pairs)
        return arrange_pictures(step, pairs, pictures[0], self.name)

    def _describe_renames(self, inputs: DeclaredInputs, pictures: Sequence[str]) -> str:
        """Return the checkpoint's own map in words, and where `--camera` contradicts it; empty without one."""
        sources = renamed_features(map(full_name, pictures), inputs.renames)
        unlike = [
            f"{camera} is given {name}, and the map says {features[0].removeprefix(IMAGES)}"
            for camera, name in self.settings.cameras
            if (features := sources.get(full_name(camera), [])) and full_name(name) not in features
        ]
        options = f"; contradicted by --camera: {'; '.join(unlike)}" if unlike else ""
        return map_text(inputs.renames) and f"{map_text(inputs.renames)}{options}"

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Set up the first chosen episodes, let the policy predict once, and execute one action of the first.

        Raises:
            OwnEnvironmentError: For cameras, states or actions that do not fit.
            UnitsError: For states far outside the checkpoint's statistics.
            CheckpointError: For a policy whose predictions are no actions.
            UsageError: For a policy that averages overlapping chunks.
        """
        if policy.predicts_relative:
            raise CheckpointError(
                f"{policy.card.checkpoint} predicts changes relative to the state (use_relative_actions), and "
                "nothing adds the state. Take a checkpoint that predicts actions"
            )
        if policy.card.ensemble is not None:
            raise UsageError(
                f"{policy.card.family} averages overlapping chunks of the arm's actions; an environment has its "
                "own units. Leave that option out"
            )
        environment, name = open_environment(self.settings), self.name
        try:
            first = start_episode(environment, self.episodes[0][1], name)
            first = self._map_cameras(environment, first, policy.card.inputs(policy.state_numbers))
            policy = self._with_cameras(policy, first.observation)
            self._check_state(policy, first.observation)
            chunk = self._check_prediction(policy, first.observation)
            with naming_environment(name, "step()"):
                second = environment.step(np.array(chunk[0]))
            second = checked_step(second, self.episodes[0][1], f"{name}, step() 1")
            self._note_facts(second)
            later = [episode for _, episode in self.episodes[1:FIRST_EPISODES]]
            later = later if policy.state_numbers is not None else []
            begins = [first, *(start_episode(environment, episode, name) for episode in later)]
            for begin in begins:
                self._check_state(policy, begin.observation)
            ids = [episode.id for _, episode in self.episodes]
            steps = [[first, second], *([begin] for begin in begins[1:])]
            self._frames = [frames_of_steps(*pair) for pair in zip(ids, steps, strict=False)]
            states = np.stack([begin.observation.state for begin in begins])
        finally:
            environment.close()
        self.seen, self.chunk = first.observation, len(chunk)
        self.units = compare_states(policy, [states], self._state_names, begins=True)
        check_units(self.units, f"{name}, the state after reset()", policy, accept_units)
        return self, policy

    def _note_facts(self, step: Step) -> None:
        self.columns = tuple(sorted(step.facts))
        self.truths = [name for name in self.columns if isinstance(step.facts[name], bool | np.bool_)]

    def shown_cameras(self, declared: "DeclaredInputs | None" = None) -> tuple[str, ...] | None:
        """Return the first camera, and those that the first observation names; None if they are unknown.

        The first episode is set up for this if no model was checked and `declared` has the cameras of one.
        """
        if not self.cameras and declared is not None:
            self._begin(declared, True)
        return tuple(self.cameras) or None

    def _with_cameras(self, policy: "Policy", observation: Observation) -> "Policy":
        self.cameras = [*policy.card.cameras[:1], *observation.cameras]
        turned = [camera for camera, _ in self.settings.rotations if camera != EVERY_CAMERA]
        if strange := [camera for camera in turned if camera not in self.cameras]:
            raise UsageError(
                f"--rotate {strange[0]}=…: {self.name} has no such camera; it shows {', '.join(self.cameras)}"
            )
        try:
            return policy.with_cameras(self.cameras)
        except ObservationError as error:
            raise OwnEnvironmentError(
                f"{self.name}: {error}. `Observation.image` is the model's first camera; name the others in "
                "`Observation.cameras` as the model does, or map them with --camera"
            ) from error

    def _check_state(self, policy: "Policy", observation: Observation) -> None:
        expected = policy.state_numbers
        if expected is not None and observation.state.shape != (expected,):
            raise OwnEnvironmentError(
                f"{self.name} has a state of {observation.state.size} numbers; {policy.card.checkpoint} reads "
                f"{expected}. Take a checkpoint of this environment"
            )

    def _check_prediction(self, policy: "Policy", observation: Observation) -> NDArray[np.float32]:
        """Return the actions (chunk, D) of one prediction. Raises OwnEnvironmentError if width or order differ."""
        predicted = predicted_once(policy, observation)
        if predicted.shape[1] != len(self.actions):
            raise OwnEnvironmentError(
                f"{self.name} takes {len(self.actions)} numbers as an action ({', '.join(self.actions)}); "
                f"{policy.card.checkpoint} predicts {predicted.shape[1]}. Take a checkpoint of this environment"
            )
        if (reason := exchanged_names(policy, self.actions)) is not None:
            raise OwnEnvironmentError(
                f"{self.name}: {reason}. Let step() take actions in the checkpoint's order, and name them so"
            )
        return predicted

    def example(self, instruction: str) -> Observation:
        """Return the first observation with a blank picture."""
        assert self.seen is not None
        return replace(self.seen, image=np.zeros_like(self.seen.image), instruction=instruction)

    def play(self, played: Played) -> Opens:
        """Open a player, with an environment of its own."""
        return partial(EnvironmentPlayer, self.settings, self.columns, played, self.starts)

    # -- what a run says of it -----------------------------------------------------------------------

    @property
    def _state_names(self) -> list[str]:
        return [] if self.seen is None else [str(position) for position in range(self.seen.state.size)]

    def identity(self, execute: int) -> dict[str, Any]:
        """Return the environment by its revision, and what it shows; empty before a model is loaded."""
        if self.seen is None:
            return {ENVIRONMENT: {}}
        settings, observation = self.settings, self.seen
        shapes: dict[str, list[int]] = {
            **({"action": [execute, len(self.actions)]} if execute else {}),
            **({"columns": [len(self.columns)]} if self.columns else {}),
            **({"state": [int(observation.state.size)]} if self._state_names else {}),
            **({"pixels": [1 + len(observation.cameras), SIDE, SIDE, 3]} if settings.pixels else {}),
        }
        environment = {
            "kind": "env",
            "environment": settings.environment,
            "options": dict(settings.options),
            "revision": self.revision,
            "max_steps": None if self._has_limits_of_episodes else settings.steps(),
            **({"rotations": [list(turn) for turn in settings.rotations]} if settings.rotations else {}),
            "cameras": [list(pair) for pair in settings.cameras] or self.cameras,
            "inputs": shapes,
            "columns": list(self.columns),
            "names": {
                "action": list(self.actions),
                **({"state": self._state_names} if self._state_names else {}),
                **({TRUTHS: self.truths} if self.truths else {}),
            },
        }
        return {ENVIRONMENT: environment}

    def check_same(self, settings: Mapping[str, Any]) -> None:
        """Raise OtherFramesError for another revision."""
        if (stored := settings[ENVIRONMENT]["revision"]) != self.revision:
            raise OtherFramesError(
                f"{self.name} has the revision {self.revision!r}; the run was played in {stored!r}. Use that one"
            )

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the numbers of the selected episodes."""
        return {"played": {"name": self.name, "episodes": [row.columns["env_episode"] for row in rows]}}

    def targets(self) -> tuple[str, ...]:
        """Return the facts of the environment."""
        return tuple(f"env.{name}" for name in self.columns)

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return environment, cameras, actions, facts, episodes with their limit, and what a group is."""
        groups = {row.columns["group_id"] for row in rows}
        described = {
            "environment": terminal_safe(self.name),
            "episodes": f"{len(rows)} in {plural(len(groups), 'group')}, {self._limit_words(rows)}",
            "groups": self._group_words(rows),
            "starts": self._start_words,
        }
        if self.seen is None:
            return described
        pairs = self.settings.cameras
        return {
            "environment": terminal_safe(f"{self.name} ({self.revision})"),
            "cameras": terminal_safe(
                "; ".join(f"{camera} from {name}{self._turned_by(camera)}" for camera, name in pairs)
                or ", ".join(f"{camera}{self._turned_by(camera)}" for camera in self.cameras)
            ),
            **({"rename map": terminal_safe(self.renamed)} if self.renamed else {}),
            "actions": terminal_safe(", ".join(self.actions)),
            "facts": terminal_safe(", ".join(self.columns)) or "none",
            **{name: words for name, words in described.items() if name != "environment"},
        }

    def _turned_by(self, camera: str) -> str:
        degrees = degrees_of(self.settings.rotations, camera)
        return f", rotated by {degrees}°" if degrees else ""

    def _limit_words(self, rows: Sequence[Row]) -> str:
        settings, most = self.settings, sorted({self.most_steps(row.content) for row in rows})
        limits = sorted({limit for row in rows if (limit := limit_in(settings, row.content)) is not None})
        actions = f"at most {describe_range(most)} actions each"
        if settings.max_steps is None:
            if not limits:
                return f"{actions}: the environment declares no limit of its own, --max-steps gives another"
            bounded = " up to" if limits[-1] > most[-1] else ""
            return f"{actions}:{bounded} the environment's own limit{f' of {limits[-1]}' if bounded else ''}"
        if not limits:
            return f"{actions}: --max-steps; the environment declares no limit of its own"
        shorter = "; rates are not the benchmark's" if most[-1] < limits[-1] else ""
        return f"{actions}: --max-steps; the environment's own limit is {describe_range(limits)}{shorter}"

    def _group_words(self, rows: Sequence[Row]) -> str:
        groups: list[str | None] = [row.content.group for row in rows]
        if all(group is None for group in groups):
            return "every episode is one, because its seed starts it anew"
        words = "the environment names them"
        return words if None not in groups else f"{words}; an episode without one is its own"

    @property
    def _start_words(self) -> str:
        if self.settings.accept_nondeterminism:
            return "not checked: --accept-nondeterminism; episodes may not repeat"
        if self.starts_are_equal:
            first, second = (terminal_safe(episode.id) for _, episode in self.episodes[:2])
            return (
                f"{first} and {second} start with the same observation, though they are two groups: "
                f"train with --group-by {START}"
            )
        return "one seed, set up twice, starts equally" if self.starts else ""


class EnvironmentPlayer(InputsPlayer):
    """A player of the episodes of one environment, which keeps what labels and controls are made of.

    Args:
        settings: The settings of the environment, of which the player opens its own.
        facts: The names of the facts, in stored order.
        played: The frames and inferences to keep.
        starts: The hashes of first observations by episode, as another process saw them.
    """

    def __init__(
        self,
        settings: EnvironmentSettings,
        facts: Sequence[str],
        played: Played,
        starts: Mapping[str, str] | None = None,
    ) -> None:
        self._settings, self._facts, self._played = settings, tuple(facts), played
        self._starts = dict(starts or {})
        self._environment = open_environment(settings)

    def begin(self, row: Row, film: bool) -> Answer:
        """Set an episode up. Raises OtherFramesError if it starts otherwise than in another process."""
        del film
        self.row, self._steps, self._succeeded = row, 0, False
        self._clear()
        step = start_episode(self._environment, row.content, self._settings.name)
        self._start = start_digest(step)
        if self._starts.get(row.content.id, self._start) != self._start:
            raise OtherFramesError(
                f"{self._settings.name}: the episode {row.content.id!r} starts otherwise than it did when the run "
                "was prepared, in the process that plays it. Take all randomness from the episode's seed, or play "
                "it with --accept-nondeterminism"
            )
        step = self._arrange(step)
        self._first = _pictures(step)
        return self._see(step)

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Execute actions (n, D) until they or the episode end."""
        self._keep("action", actions, self._played.calls)
        name, most = self._settings.name, most_steps(self._settings, self.row.content)
        for action in actions:
            with naming_environment(name, "step()"):
                answer = self._environment.step(action.copy())
            self._steps += 1
            step = self._arrange(checked_step(answer, self.row.content, f"{name}, step() {self._steps}"))
            self._succeeded |= _succeeds(step)
            if step.done or self._steps >= most:
                return self._end(step)
        return self._see(step)

    def close(self) -> None:
        """Free the environment."""
        with naming_environment(self._settings.name, "close()"):
            self._environment.close()

    def _arrange(self, step: Step) -> Step:
        return arrange_pictures(
            step, self._settings.cameras, first_picture(self._environment), self._settings.name
        )

    def _see(self, step: Step) -> Observation:
        observation, most = step.observation, self._played.calls
        self._keep_pictures(_pictures(step), self._settings.pixels, most)
        if observation.state.size:
            self._keep("state", observation.state, most)
        where = f"{self._settings.name}, step() {self._steps}"
        unknown = self._steps == 0 and not step.facts  # nothing is said of the beginning
        facts = [np.nan] * len(self._facts) if unknown else fact_values(step.facts, self._facts, where)
        if self._facts:
            self._keep("columns", np.array(facts, np.float64), most)
        return observation

    def _end(self, step: Step) -> Ending:
        fact_values(step.facts, self._facts, f"{self._settings.name}, step() {self._steps}")
        at_end, has_success = _succeeds(step), SUCCESS in self._facts
        outcome = {
            "outcome": (SUCCEEDED if at_end else FAILED) if has_success else ENDED,
            **({ONCE: self._succeeded, AT_END: at_end} if has_success else {}),
            "steps": self._steps,
            "done": bool(step.done),
            **({} if (limit := limit_in(self._settings, self.row.content)) is None else {LIMIT: limit}),
            START: self._start,
        }
        return self._ending(outcome, self._small_frames(_pictures(step)))

    def _small_frames(self, last: list[NDArray[np.uint8]]) -> SmallFrames:
        """Return the first and the last frame of all cameras side by side, in small."""
        return () if self._played.frames == "none" else (shrink(*self._first), shrink(*last))


def frames_of_steps(name: str, steps: Sequence[Step]) -> EpisodeFrames:
    """Return pictures and states of some steps of an episode, to look for inputs without content."""
    states = np.stack([step.observation.state for step in steps]).astype(np.float64)
    return frames_of_episode(name, [_pictures(step) for step in steps], states)


def _pictures(step: Step) -> list[NDArray[np.uint8]]:
    """Return the pictures of all cameras, the first one in front."""
    return [step.observation.image, *step.observation.cameras.values()]


def _succeeds(step: Step) -> bool:
    return bool(step.facts.get(SUCCESS, False))
