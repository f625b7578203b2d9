"""A session of a policy server: episodes of its clients, one inference at a time, and the run that they make.

A session knows no network protocol. All methods but `connect` are called one at a time, on the thread that infers.
Another thread writes.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from threading import Lock
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import (
    CaptureChangedActionError,
    InstructionError,
    ObservationError,
    PolicyFailedError,
    ProbeKitError,
    StoreError,
    UnitsError,
)
from probe_kit.extract.rollout.capturing import EpisodeBuffers, stored_streams
from probe_kit.extract.rollout.controllers import PolicyController, Turn, count_lost_words
from probe_kit.extract.rollout.worker import Playing, certificate_of, torch_threads, write_episode
from probe_kit.extract.settings import CONFIG, ExtractSettings, run_label
from probe_kit.extract.sources.conditions import next_condition
from probe_kit.extract.sources.player import EPISODE_ERRORS, traceback_of
from probe_kit.extract.sources.served_source import Received, ServedEpisode, ServedSource, flat_keys
from probe_kit.extract.states import Fitted
from probe_kit.hashing import derive_seed
from probe_kit.runs.commits import failure_key, read_commits
from probe_kit.runs.layout import (
    AT_END,
    CAPTURE_ONLY,
    CONDITION,
    DATASET,
    POSSIBLE_STARTS,
    UNITS,
    StoredStream,
)
from probe_kit.runs.plan import Plan, Row
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.run import Run
from probe_kit.runs.store import Location
from probe_kit.runs.verify import seal
from probe_kit.runs.writer import RunWriter
from probe_kit.serve.marks import SUCCESS, Facts, Mark
from probe_kit.serve.resets import ResetEvidence, Resets

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

EXAMPLE = "put the cube on the red shape"
"""Words by which sizes are counted before a client sends any."""
CATEGORY = "all"
"""The category of every row: served episodes have no categories."""
SUCCEEDED, FAILED = "success", "failure"
"""The outcomes of episodes of which success is said."""
FACT = "env."
"""The prefix of a fact among the columns of episodes."""
FIRST_GROUPS, EVERY_GROUPS = 4, 50
"""The groups whose first states are compared before they are answered: the first ones, then each 50th episode."""
MOST_STATES = 200
"""The most first states that are compared."""
LONGEST_INTERVALS, LEAST_PAUSE = 10.0, 5.0
"""A pause is ten times the longest interval so far, and 5 seconds at least."""
MOST_WAITING = 8
"""The most episodes that wait to be written: a model cannot outrun the disk."""
_OF_A_REQUEST = (ObservationError, InstructionError, UnitsError)
"""Errors of an observation: the client gets their text, and the episode stays open."""
UNFINISHED = "the server ended before its commit"


@dataclass
class OpenEpisode:
    """An episode that a client plays.

    Attributes:
        name: The id of its row.
        item: The id that the client gave, or that it was numbered with.
        began: What began it.
        client: The name of the client.
        instruction: The words of all its inferences.
        playing: What is captured and counted.
        record: The inputs that are shown again later.
        inferences: The number of inferences so far, captured or not.
        steps: The number of actions executed before each captured inference, as far as it is said.
        possible_starts: The number of its observations that may begin another episode, without marks.
        failure: Why it is given up, with the traceback; None while nothing failed.
        is_marked: Whether the client said that it began.
        condition: The condition whose edits it gets; empty where the run has no conditions.
        columns: Further columns of its row, as the client said them.
        actions: The number of actions that were executed; None where that is unknown.
    """

    name: str
    item: str
    group: str
    began: str
    client: str
    instruction: str
    playing: Playing
    record: ServedEpisode
    is_marked: bool
    condition: str = ""
    inferences: int = 0
    steps: list[int | None] = field(default_factory=list)
    last_step: int = -1
    columns: Mapping[str, str] = field(default_factory=dict)
    actions: int | None = None
    possible_starts: int = 0
    failure: tuple[str, str] | None = None


@dataclass
class Client:
    """One connection.

    Attributes:
        name: The name that its address gives, or one by its number.
        connection: The number of the connection among those of this name, from 1 on.
        group: The group of its episodes that say none.
        episode: Its episode now.
        answered: When its last observation was answered; None before.
        longest: The longest interval between two observations so far, in seconds.
        resets: The states so far, where the client does not say its episodes.
        judged: The evidence of the state that is answered, for a reset.
    """

    name: str
    connection: int
    group: str
    episode: OpenEpisode | None = None
    answered: float | None = None
    longest: float = 0.0
    resets: Resets = field(default_factory=Resets)
    judged: ResetEvidence = field(default_factory=ResetEvidence)


@dataclass(frozen=True)
class Line:
    """The end of an episode, as the terminal shows it.

    Attributes:
        number: Its number in the run; None for one that was given up before it had any.
        outcome: Its outcome in a word.
        failure: Why it was given up; empty for one that is committed.
        possible_starts: The number of its observations that may begin another episode, without marks.
    """

    number: int | None
    episode: str
    client: str
    inferences: int
    captured: int
    outcome: str
    seconds: float
    failure: str = ""
    possible_starts: int = 0


class Session:
    """The episodes of all clients of a server, and their run.

    Attributes:
        refused: The number of observations that were refused.
        committed: The number of episodes that were committed.
        failed: The number of episodes that were given up.
        fatal: The error that ends the server; None while there is none.

    Args:
        settings: The settings of the run, whose source is a `ServedSettings`.
        source: The source, checked against the policy.
        policy: The loaded policy.
        location: The place of the run.
        report: Called with a line per episode, on the thread that writes.
        versions: The versions of the wire's packages, for the certificate.
    """

    def __init__(
        self,
        fitted: Fitted[ExtractSettings],
        source: ServedSource,
        policy: "Policy",
        location: Location,
        report: Callable[[Line], None],
        versions: Mapping[str, str],
    ) -> None:
        self._fitted, self._settings = fitted, fitted.settings
        self._source, self._location = source, location
        self._loaded = self._policy = policy
        self._report, self._versions = report, versions
        self._controller: PolicyController | None = None
        self._writer: RunWriter | None = None
        self._thread = ThreadPoolExecutor(1, "probe-kit-writer")
        self._waiting: list[Future[None]] = []
        self._free: list[EpisodeBuffers] = []
        self._lock = Lock()
        self._check: tuple[OpenEpisode, Turn, Received, NDArray[np.float32]] | None = None
        self._names: set[str] = set()
        self._numbers: Counter[str] = Counter()
        self._certified: set[str] = set()
        self._conditions: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._connections: Counter[str] = Counter()
        self._first_states: list[NDArray[np.float32]] = []
        self._begun_groups: set[str] = set()
        self._proved = False
        self._held = ExitStack()
        self._lost_words: dict[str, int] = {}
        self._faults: list[tuple[OpenEpisode, Row, str, str]] = []
        self._clients: dict[int, Client] = {}
        self._connected = self._begun = 0
        self._keys: dict[str, str] = {}
        self._latency = 0.0
        self.refused = self.committed = self.failed = 0
        self.fatal: BaseException | None = None

    # -- the run -------------------------------------------------------------------------------------

    def open_stored(self, stored: Run | None) -> None:
        """Continue the run that is there, with its sizes, numbers and names.

        Raises:
            SettingsMismatchError: For a run with other settings.
        """
        if stored is None:
            return
        plan = stored.root.plan
        self._source.adopt(stored.root.own_settings[DATASET], [str(row["instruction"]) for row in plan[:1]])
        self._policy = self._source.with_cameras_of(self._loaded)
        for row in plan:
            client = str(row["client"])
            self._names.add(str(row["episode_id"]))
            self._connections[client] = max(self._connections[client], int(row["connection"]))
            if (condition := row.get(CONDITION)) is not None and row["began"] != "words":
                self._conditions[str(row["group_id"])][str(condition)] += 1
            if not row["marked"]:
                number = int(str(row["item_id"]).rpartition("/")[2])
                self._numbers[client] = max(self._numbers[client], number)
        self._begin_controller()
        self._writer = self._make_writer()
        self._name_unfinished(self._writer)

    def _name_unfinished(self, writer: RunWriter) -> None:
        """Give the episodes up by name that a kill left between their plan and their commit."""
        committed = read_commits(writer.root)
        for number in sorted(writer.root.planned.keys() - committed.keys()):
            if not self._location.exists(failure_key(number)):
                writer.give_up(number, UNFINISHED)

    def _begin_controller(self) -> None:
        self._controller = PolicyController(self._policy, self._source, self._settings)

    def _make_writer(self) -> RunWriter:
        assert self._controller is not None, "the first observation makes it"
        settings, controller, source = self._settings, self._controller, self._source
        selection = {**source.selection(()), CONFIG: settings.stored_config()}
        if notes := source.unit_notes(settings.machine.accept_units):
            selection[UNITS] = {name: {**vars(note)} for name, note in notes.items()}
        plan = Plan((), tuple(controller.streams), 0, {}, selection)
        identity = {**settings.identity(), **controller.identity, **source.identity(controller.execute)}
        provenance = provenance_here(settings.machine.device, controller.identity["dtype"])
        with self._location.explained_errors():
            writer = RunWriter(self._location, plan, identity, provenance, run_label(settings))
            writer.begin(settings.machine.allow_mixed)
            self._held.enter_context(writer.take_part())
        return writer

    @property
    def source(self) -> ServedSource:
        """The source, which knows cameras and shapes."""
        return self._source

    @property
    def streams(self) -> tuple[StoredStream, ...]:
        """The storage of the streams of the policy, for one instruction."""
        controller = self._controller
        if controller is None:
            example = self._source.example(EXAMPLE)
            with suppress(ProbeKitError):
                return tuple(stored_streams(self._policy, self._policy.roles([example])))
            return ()
        return tuple(controller.streams)

    @property
    def width(self) -> tuple[int, ...]:
        """The count of numbers of an action, as the end of a shape."""
        return self._source.prediction[1:]

    def certified(self) -> dict[str, Any]:
        """Return what the certificate says of the session so far."""
        settings = self._source.settings
        return {
            "served": {
                "wire": settings.wire,
                "versions": dict(self._versions),
                "keys": dict(self._keys),
                "never_read": sorted(self._keys.keys() - self._source.read_keys()),
                "episodes": "said" if settings.says_episodes else settings.rule,
                "clients": self._connected,
                "committed": self.committed,
                "largest_latency_s": round(self._latency, 3),
            }
        }

    # -- clients -------------------------------------------------------------------------------------

    def connect(self, name: str = "") -> Client:
        """Return a new connection; a client without a name is numbered by arrival."""
        if not name:
            number = next(n for n in itertools.count(1) if f"client-{n:03d}" not in self._connections)
            name = f"client-{number:03d}"
        self._connections[name] += 1
        connection = self._connections[name]
        client = Client(name, connection, name if connection == 1 else f"{name} connection {connection}")
        self._clients[id(client)] = client
        self._connected += 1
        return client

    def leave(self, client: Client) -> None:
        """End the episode of a connection that is over."""
        self._clients.pop(id(client), None)
        try:
            self._finish_check()
        finally:
            self._end(client, "connection")

    def wait(self) -> None:
        """Wait until all episodes that ended are written."""
        self._thread.submit(lambda: None).result()

    def close(self) -> Run | None:
        """End all open episodes, write what waits, seal the run and return it; None without any episode.

        Raises:
            ProbeKitError: The error that ended the server, once all else is written.
        """
        try:
            with suppress(Exception):  # it is `fatal` from then on
                self._finish_check()
            for client in list(self._clients.values()):
                self._end(client, "connection")
        finally:
            self._thread.submit(self._record_faults)
            self._thread.shutdown(wait=True)
        if self._writer is None or not self._writer.root.plan:
            return None
        with self._held, self._location.explained_errors():
            if self.committed:
                self._writer.write_certificate({**self._certificate(), **self.certified()})
            seal(self._location)
        return Run(self._location)

    def _certificate(self) -> dict[str, Any]:
        assert self._controller is not None, "a session with episodes has one"
        return certificate_of(self._controller, self._fitted)

    # -- one observation -----------------------------------------------------------------------------

    def answer(
        self,
        client: Client,
        sent: Mapping[str, Any],
        mark: Mark | None,
        arrived: float | None = None,
    ) -> NDArray[np.float32]:
        """Return the actions (chunk, D) for an observation, captured if it is one of those.

        The very first one is answered before capture is proved to change nothing; see `finish_check`.

        Args:
            client: The connection.
            sent: The observation by key.
            mark: What the client says of the episode; None for nothing.
            arrived: When it arrived, by the monotonic clock; other clients may be answered first. None for now.

        Raises:
            ObservationError: For what cannot be shown; the episode stays open.
            ProbeKitError: For a policy that failed, whose episode is given up, and for an error that ends the
                server.
        """
        self._finish_check()
        arrived = monotonic() if arrived is None else arrived
        try:
            if mark is None and self._source.settings.says_episodes:
                raise ObservationError(
                    "the observation says no episode, and the server takes said ones only (--episodes said). Add "
                    "the key probe_kit/episode, such as {'id': 'task3/7'}"
                )
            received = self._source.receive(sent)
            episode = self._episode_of(client, received, mark, arrived)
            actions = self._infer(episode, received, mark)
        except _OF_A_REQUEST:
            self.refused += 1
            self._unsettle(client)
            raise
        except (*EPISODE_ERRORS, StoreError):
            raise
        except Exception as error:  # whatever it is, all later inferences would meet it
            self.fatal = error
            raise
        self._keys = self._keys or flat_keys(sent)
        self._note_state(client, received, arrived)
        self._latency = max(self._latency, monotonic() - arrived)
        return actions

    def abandon(self, client: Client) -> None:
        """End the episode of a client that begins the next one and never said how it ended."""
        self._finish_check()
        self._end(client, "start")

    def end(self, client: Client, mark: Mark, steps: int | None = None) -> bool:
        """End the episode of a client as it says; return False if there is none of which anything was captured.

        Args:
            client: The connection.
            mark: The statement, with the facts of the episode.
            steps: The number of actions that were executed; None where that is unknown.
        """
        self._finish_check()
        episode = client.episode
        if episode is None or (mark.id and mark.id != episode.item):
            return False
        stored = episode.inferences > 0 and episode.failure is None
        episode.actions = steps
        self._end(client, "said", mark.facts)
        return stored

    def _note_state(self, client: Client, received: Received, arrived: float) -> None:
        if client.answered is not None:
            client.longest = max(client.longest, arrived - client.answered)
        client.answered = monotonic()
        episode = client.episode
        if episode is not None and not episode.is_marked:
            begins = episode.inferences == 1
            client.resets.add(received.observation.state, client.judged, begins)
            episode.possible_starts += client.judged.may_reset and not begins

    # -- episodes ------------------------------------------------------------------------------------

    def _episode_of(self, client: Client, received: Received, mark: Mark | None, arrived: float) -> OpenEpisode:
        """Return the episode of an observation, which may be a new one."""
        episode = client.episode
        words = received.observation.instruction
        if mark is not None:
            same = episode is not None and episode.is_marked and episode.item == mark.id
            if episode is not None and same and mark.condition not in (None, episode.condition):
                raise ObservationError(
                    f"probe_kit/episode: the condition of {episode.item!r} is {mark.condition!r} now; it began "
                    "with another one. A new episode has another id"
                )
            if episode is not None and same and words == episode.instruction:
                self._check_step(episode, mark)
                return episode
            group, ended = mark.group or mark.id, "words" if same else "said"
            condition = episode.condition if episode is not None and same else self._condition_of(mark, group)
            self._check_store()
            self._check_units(received, group)
            self._end(client, ended)
            return self._begin(client, received, mark.id, group, ended, True, condition, mark.columns)
        reason = self._reason_to_split(client, received, arrived)
        if episode is not None and reason is None:
            return episode
        group = words if self._source.settings.rule == "words" else client.group
        self._check_store()
        self._check_units(received, group)
        self._end(client, reason or "connection")
        self._numbers[client.name] += 1
        name = f"{client.name}/{self._numbers[client.name]:06d}"
        return self._begin(client, received, name, group, reason or "connection", False)

    def _condition_of(self, mark: Mark, group: str) -> str:
        """Return the condition of a new episode: the mark's, else one that is drawn in balanced blocks."""
        names = [condition.name for condition in self._source.settings.conditions]
        if mark.condition is not None and mark.condition not in names:
            served = ", ".join(names) or "no conditions; start it with --condition"
            raise ObservationError(
                f"probe_kit/episode: the condition is {mark.condition!r}; the server has {served}"
            )
        if mark.condition is not None or not names:
            return mark.condition or ""
        counts = self._conditions[group]
        block = min(counts[name] for name in names)
        rng = np.random.default_rng(derive_seed(self._settings.seed, CONDITION, group, block))
        return next_condition(names, counts, rng.permutation(len(names)).tolist())

    def _count_condition(self, episode: OpenEpisode, more: int) -> None:
        """Count the condition of an episode; one row of an episode of two instructions counts."""
        if episode.condition and episode.began != "words":
            self._conditions[episode.group][episode.condition] += more

    def _reason_to_split(self, client: Client, received: Received, arrived: float) -> str | None:
        """Return why an observation without a mark begins a row; None if it does not."""
        episode, settings = client.episode, self._source.settings
        client.judged = ResetEvidence()
        if episode is None:
            return None
        if episode.is_marked:
            return "said"
        if received.observation.instruction != episode.instruction:
            return "words"
        if settings.rule == "connection" or client.answered is None:
            return None
        pause = settings.pause or max(LEAST_PAUSE, LONGEST_INTERVALS * client.longest)
        if arrived - client.answered > pause:
            return "pause"
        if settings.state:
            client.judged = client.resets.judge(received.observation.state)
            if client.judged.resets:
                return "state"
        return None

    @staticmethod
    def _check_step(episode: OpenEpisode, mark: Mark) -> None:
        if mark.step is not None and mark.step <= episode.last_step:
            raise ObservationError(
                f"probe_kit/episode: step {mark.step} of {episode.item!r} comes after step {episode.last_step}; "
                "expected a larger one. A new episode has another id"
            )

    def _check_store(self) -> None:
        """Raise StoreError while episodes cannot be written; each new one tries again."""
        while self._waiting and (self._waiting[0].done() or len(self._waiting) > MOST_WAITING):
            self._waiting.pop(0).result()
        if self._faults:
            self._thread.submit(self._record_faults).result()
        if self._faults:
            raise StoreError(
                f"no further episode begins: the last one could not be stored ({self._faults[-1][2]}). Free some "
                "space, then begin the episode again"
            )

    def _check_units(self, received: Received, group: str) -> None:
        """Compare the first states of the first groups, and of each 50th episode. Raises UnitsError."""
        states = [*self._first_states, received.observation.state]
        is_first = group not in self._begun_groups and len(self._begun_groups) < FIRST_GROUPS
        if is_first or (self._begun + 1) % EVERY_GROUPS == 0:
            self._source.check_units(self._policy, states, self._settings.machine.accept_units)
        self._begun += 1
        self._first_states = states[-MOST_STATES:]
        self._begun_groups.add(group)

    def _begin(
        self,
        client: Client,
        received: Received,
        item: str,
        group: str,
        began: str,
        is_marked: bool,
        condition: str = "",
        further_columns: Mapping[str, str] | None = None,
    ) -> OpenEpisode:
        name, began = self._row_name(item, began, is_marked)
        self._names.add(name)
        if self._controller is None:
            self._source.settle(received)
            self._policy = self._source.with_cameras_of(self._loaded)
            self._begin_controller()
        seed = derive_seed(self._settings.seed, "policy", name)
        columns = {"episode_id": name, "policy_seed": seed, "instruction": received.observation.instruction}
        row = Row(-1, columns | ({CONDITION: condition} if condition else {}))
        episode = OpenEpisode(
            name, item, group, began, client.name, received.observation.instruction,
            Playing(row, self._take_buffers(), False), ServedEpisode(), is_marked, condition,
            columns=further_columns or {},
        )  # fmt: skip
        self._count_condition(episode, 1)
        client.episode = episode
        return episode

    def _unsettle(self, client: Client) -> None:
        """Forget what the first observation decided if it was refused: another one may have other sizes."""
        if self._source.prediction != (0, 0) or self._controller is None:
            return
        self._controller, self._policy = None, self._loaded
        self._source.unsettle()
        if client.episode is not None:
            self._names.discard(client.episode.name)
            self._count_condition(client.episode, -1)
            client.episode = None
        self._free.clear()

    def _row_name(self, item: str, began: str, is_marked: bool) -> tuple[str, str]:
        """Return the id of a row, and what began it: an id that was there before is another trial of it."""
        if item not in self._names:
            return item, began
        again = next(name for n in itertools.count(2) if (name := f"{item}#{n}") not in self._names)
        return again, "again" if is_marked and began == "said" else began

    def _take_buffers(self) -> EpisodeBuffers:
        with self._lock:
            if self._free:
                return self._free.pop()
        assert self._controller is not None, "it was made before the first episode"
        capture = self._settings.capture
        return EpisodeBuffers(
            self._controller.streams,
            self._fitted.calls,
            capture.tokens == "all",
            self._controller.on_gpu,
            capture.later_views,
        )

    def _give_back(self, buffers: EpisodeBuffers) -> None:
        buffers.clear()
        with self._lock:
            self._free.append(buffers)

    # -- inference -----------------------------------------------------------------------------------

    def _infer(self, episode: OpenEpisode, received: Received, mark: Mark | None) -> NDArray[np.float32]:
        controller = self._controller
        assert controller is not None, "the first observation made it"
        number, playing = episode.inferences, episode.playing
        every, calls = self._source.settings.every, self._fitted.calls
        captured = number % every == 0 and len(playing.buffers.roles) < calls and episode.failure is None
        turn = Turn(received.observation, playing.planned, number, playing.buffers if captured else None)
        started = perf_counter()
        try:
            with torch_threads(controller.threads):
                if captured and self._settings.capture.tokens == "all":
                    self._check_length(controller, received)
                first = captured and not self._proved
                actions = controller.infer_plainly(turn) if first else self._infer_turn(controller, turn, playing)
                _check_finite(actions)
        except _OF_A_REQUEST:
            raise
        except EPISODE_ERRORS as error:
            episode.failure = episode.failure or (f"{type(error).__name__}: {error}", traceback_of(error))
            raise
        playing.seconds += perf_counter() - started
        episode.inferences += 1
        if captured:
            episode.steps.append(None if mark is None else mark.step)
            if first:
                self._check, self._proved = (episode, turn, received, actions), True
            else:
                episode.record.keep(received, actions, self._source.settings)
        if mark is not None and mark.step is not None:
            episode.last_step = mark.step
        if self._source.prediction == (0, 0):
            self._source.prediction = actions.shape
        return actions

    def _check_length(self, controller: PolicyController, received: Received) -> None:
        """Raise InstructionError for an observation of more tokens than the run has room for."""
        roles = self._policy.roles([received.observation])
        for stream in controller.streams:
            if (length := len(roles[stream.name][0])) > stream.stored_tokens:
                raise InstructionError(
                    f"the instruction makes {length} tokens of {stream.name}; the run stores "
                    f"{stream.stored_tokens}, as its first instruction needed. Send shorter words, or serve with "
                    "--tokens pooled"
                )

    @staticmethod
    def _infer_turn(controller: PolicyController, turn: Turn, playing: Playing) -> NDArray[np.float32]:
        (inference,) = controller.infer([turn])
        assert inference.actions is not None, "a policy that is served acts"
        if inference.flagged is not None:
            playing.flagged = (playing.flagged or 0) + inference.flagged
        return inference.actions

    def finish_check(self) -> None:
        """Prove on the first answer, once it is sent, that capture changes nothing; its error ends the server."""
        with suppress(Exception):  # it is `fatal` from then on
            self._finish_check()

    def _finish_check(self) -> None:
        """Make the captured inference of the first answer. Raises the error that ends the server."""
        if self.fatal is not None:
            raise self.fatal
        if self._check is None:
            return
        (episode, turn, received, sent), self._check = self._check, None
        assert self._controller is not None, "it gave the answer"
        try:
            with torch_threads(self._controller.threads):
                actions = self._infer_turn(self._controller, turn, episode.playing)
            if actions.tobytes() != sent.tobytes():
                raise CaptureChangedActionError(
                    f"the first answer and its captured repetition differ by up to "
                    f"{np.abs(actions - sent).max():.3g}; they must be equal bit for bit"
                )
        except Exception as error:
            episode.failure = f"{type(error).__name__}: {error}", traceback_of(error)
            self.fatal = error
            raise
        episode.record.keep(received, sent, self._source.settings)

    # -- the end of an episode -----------------------------------------------------------------------

    def _end(self, client: Client, ended: str, facts: Facts | None = None) -> None:
        """Hand the episode of a client over to the thread that writes; one without an inference leaves nothing."""
        episode, client.episode = client.episode, None
        if episode is None:
            return
        if not episode.inferences and episode.failure is None:
            self._names.discard(episode.name)
            self._count_condition(episode, -1)
            self._give_back(episode.playing.buffers)
            return
        row = self._row_of(episode, ended, client)
        self._waiting.append(self._thread.submit(self._store, episode, row, dict(facts or {})))

    def _row_of(self, episode: OpenEpisode, ended: str, client: Client) -> Row:
        captured = len(episode.playing.buffers.roles)
        columns: dict[str, Any] = {
            "episode_id": episode.name,
            "item_id": episode.item,
            "category": CATEGORY,
            "group_id": episode.group,
            "instruction": episode.instruction,
            "client": episode.client,
            "connection": client.connection,
            "marked": episode.is_marked,
            "began": episode.began,
            "ended": ended,
            POSSIBLE_STARTS: episode.possible_starts,
            "source_episode": 0,
            "first_frame": 0,
            "frame_step": self._source.settings.every,
            "frames": captured,
            "recorded_frames": episode.inferences,
            "policy_seed": episode.playing.planned.policy_seed,
            "content_blake2b": episode.record.content_blake2b,
            **({CONDITION: episode.condition} if episode.condition else {}),
            **episode.columns,
        }
        return Row(-1, columns)

    # -- on the thread that writes -------------------------------------------------------------------

    def _store(self, episode: OpenEpisode, row: Row, facts: dict[str, Any]) -> None:
        """Plan and commit an episode, or give it up by name; no error of storing leaves this thread."""
        playing, number = episode.playing, None
        outcome = _outcome(facts)
        try:
            self._writer = self._writer or self._make_writer()
            if episode.failure is not None:
                self._faults.append((episode, row, *episode.failure))
                self.failed += 1
                self._record_faults()
                self._say(episode, None, "given up", episode.failure[0])
                return
            planned = self._add(row, playing.buffers.roles)
            number = planned.index
            playing.planned = planned
            playing.control_steps = _control_steps(episode, self._source.settings.every)
            playing.instruction_ids = self._instruction_ids(episode.instruction)
            playing.lost_words = self._lost_words[episode.instruction]
            counts = {"inferences": episode.inferences}
            counts |= {} if episode.actions is None else {"steps": episode.actions}
            ending = episode.record.ending({**outcome, **counts})
            assert self._controller is not None, "it inferred"
            write_episode(self._writer, self._controller, self._fitted, playing, ending, self.certified())
            self.committed += 1
            self._certify_condition(episode.condition)
            self._say(episode, number, outcome["outcome"])
        except Exception as error:  # noqa: BLE001 - whatever it is, the clients play on
            reason = f"{type(error).__name__}: {error}"
            self.failed += 1
            failed = row if number is None else replace(row, index=number)
            self._faults.append((episode, failed, reason, traceback_of(error)))
            self._say(episode, number, "not stored", reason)
        finally:
            self._give_back(playing.buffers)

    def _certify_condition(self, name: str) -> None:
        """Record what the edits of a condition did when it comes for the first time: a kill keeps that record."""
        if not name or name in self._certified:
            return
        assert self._writer is not None, "its episode is committed"
        with suppress(OSError, ProbeKitError):  # the episode is committed, and the record at the end raises
            self._writer.write_certificate({**self._certificate(), **self.certified()})
            self._certified.add(name)

    def _add(self, row: Row, spans: Sequence[Mapping[str, Sequence[tuple[str, int, int]]]]) -> Row:
        assert self._writer is not None, "it was made before"
        numbered = replace(row, columns={**row.columns, "source_episode": len(self._writer.root.stored_plan.rows)})
        streams = [
            replace(stream, tokens=max(stream.tokens, _length(spans, stream.name)))
            for stream in self._writer.plan.streams
        ]
        with self._location.explained_errors():
            return self._writer.add(numbered, streams)

    def _instruction_ids(self, instruction: str) -> Sequence[int] | None:
        assert self._controller is not None, "it inferred"
        ids = self._controller.instruction_ids
        if instruction not in self._lost_words:
            self._lost_words[instruction] = count_lost_words(ids, instruction)
        return ids(instruction)

    def _record_faults(self) -> None:
        """Write down which episodes were given up; those that cannot be written yet stay."""
        remaining = []
        for fault in self._faults:
            episode, row, reason, traceback = fault
            try:
                self._writer = self._writer or self._make_writer()
                planned = self._add(row, ()) if row.index < 0 else row
                fault = episode, planned, reason, traceback
                self._writer.give_up(planned.index, reason, traceback)
            except Exception:  # noqa: BLE001 - the disk is still full
                remaining.append(fault)
        self._faults = remaining

    def _say(self, episode: OpenEpisode, number: int | None, outcome: str, failure: str = "") -> None:
        captured = len(episode.playing.buffers.roles)
        self._report(
            Line(
                number,
                episode.name,
                episode.client,
                episode.inferences,
                captured,
                outcome,
                episode.playing.seconds,
                failure,
                episode.possible_starts,
            )
        )


def _length(spans: Sequence[Mapping[str, Sequence[tuple[str, int, int]]]], stream: str) -> int:
    """Return the length of the longest sequence of a stream among the spans of some inferences."""
    return max((stop for inference in spans for _, _, stop in inference.get(stream, ())), default=0)


def _outcome(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of an episode's outcome."""
    columns = {f"{FACT}{name}": value for name, value in facts.items()}
    if SUCCESS not in facts:
        return {"outcome": CAPTURE_ONLY, **columns}
    return {"outcome": SUCCEEDED if facts[SUCCESS] else FAILED, AT_END: bool(facts[SUCCESS]), **columns}


def _control_steps(episode: OpenEpisode, every: int) -> list[int]:
    """Return the steps of the captured inferences as they are said, else their numbers."""
    steps = [step for step in episode.steps if step is not None]
    return steps if len(steps) == len(episode.steps) else [number * every for number in range(len(episode.steps))]


def _check_finite(actions: NDArray[np.float32]) -> None:
    if not np.isfinite(actions).all():
        raise PolicyFailedError(
            "the policy predicted NaN or infinity; no action is sent. Correct the observation or the checkpoint"
        )
