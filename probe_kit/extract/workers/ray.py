"""Workers on a Ray cluster."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Self

from probe_kit._execution.ray_cluster import answer_of, ray_cluster
from probe_kit._system.optional_dependencies import require
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.extract.rollout.events import Done, Event
from probe_kit.extract.settings import Settings
from probe_kit.extract.workers.loading import load_worker
from probe_kit.extract.workers.scheduler import Scheduler
from probe_kit.extract.workers.worker_errors import tell_lost
from probe_kit.runs.commits import commit_key, read_commit
from probe_kit.runs.root import read_root
from probe_kit.runs.store import locate

# Episodes per call, so that a worker always has something to simulate while it infers; fewer towards the end.
EPISODES_PER_CALL = 8
# So many workers in a row that die before they could begin are no accident of one node.
STILLBORN = 3
# Seconds without any worker before a warning.
PATIENCE = 300.0


class ClusterFullWarning(UserWarning):
    """No node of the cluster has room for a worker; the extraction waits for one."""


def run_on_ray(settings: Settings, run: str, scheduler: Scheduler, on_event: Callable[[Event], None]) -> None:
    """Play the episodes in actors of a Ray cluster, one per GPU, all of which see the location `run`.

    An actor that dies is replaced; what it held is tried again by the scheduler, as in every transport.
    Raises MissingExtraError without Ray, UsageError if no cluster answers, and what an actor raises.
    """
    with RayWorkers(settings, run) as workers:
        while not scheduler.finished:
            workers.hand_out(scheduler)
            for event in workers.collect(scheduler):
                on_event(event)


class RayActor:
    """What runs on a node: the same worker as everywhere."""

    def __init__(self, settings: Settings, run: str) -> None:
        self._settings, self._run = settings, run
        self._opened = ExitStack()
        self._worker: Any = None

    def begin(self) -> ProbeKitError | None:
        """Load the model. What is wrong with the whole run is an answer: Ray would wrap what is raised."""
        try:
            self._worker = self._opened.enter_context(load_worker(self._settings, self._run))
        except ProbeKitError as error:
            return error
        return None

    def node(self) -> str:
        """Where it is, as `ray list nodes` names it."""
        node: str = require("ray", "ray").get_runtime_context().get_node_id()
        return node

    def play(self, numbers: Sequence[int]) -> list[Event] | ProbeKitError:
        """Play and commit these episodes."""
        ahead = iter(numbers)
        try:
            return list(self._worker.run(lambda: next(ahead, None)))
        except ProbeKitError as error:
            return error


class RayWorkers:
    """Actors on a cluster, as many as GPUs, or as `settings.machine.workers` says. A context manager.

    Each holds a GPU, if there are any, and a core, so that nodes share them; an actor gets episodes once it has
    loaded its model. One without room, because a node was lost, gets none and delays no other.
    """

    def __init__(self, settings: Settings, run: str) -> None:
        self._settings, self._run = settings, run
        self._on_gpu = settings.machine.device.startswith("cuda")
        self._actors: dict[int, Any] = {}
        self._calls: dict[Any, int] = {}
        self._nodes: dict[int, str] = {}
        """Of every worker that has begun."""
        self._seen: dict[int, set[str]] = {}
        """The nodes that were alive when a worker was started."""
        self._stillborn = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._ray = ray = stack.enter_context(
                ray_cluster(self._settings.machine.ray or "auto", log_to_driver=True)
            )
            gpus = (
                int(ray.cluster_resources().get("GPU", 0))
                if self._settings.machine.device.startswith("cuda")
                else 0
            )
            # Ray could restart an actor itself, but fails every call meanwhile: episodes would seem to kill it
            # twice.
            options = {
                "num_gpus": 1 if gpus else 0, "num_cpus": 1, "max_restarts": 0, "max_task_retries": 0,
                "scheduling_strategy": "SPREAD",
            }  # fmt: skip
            self._kind = ray.remote(**options)(RayActor)
            for slot in range(self._settings.machine.workers or max(1, gpus)):
                self._start(slot)
            self._opened = stack.pop_all()
        return self

    def _start(self, slot: int) -> None:
        actor = self._kind.remote(self._settings, self._run)
        self._actors[slot], self._seen[slot] = actor, self._alive()
        self._calls[actor.begin.remote()] = slot

    def _alive(self) -> set[str]:
        return {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}

    def __exit__(self, *_: object) -> None:
        with self._opened:
            for actor in self._actors.values():
                self._ray.kill(actor)

    def hand_out(self, scheduler: Scheduler) -> None:
        """Give every idle actor something to play."""
        for slot in sorted(self._nodes.keys() - set(self._calls.values())):
            numbers = scheduler.take_some(slot, EPISODES_PER_CALL)
            if numbers:
                self._calls[self._actors[slot].play.remote(numbers)] = slot

    def collect(self, scheduler: Scheduler) -> list[Event]:
        """Wait for one actor and note what became of its episodes. Raises what is wrong with all of them."""
        ready = self._next_answer()
        slot = self._calls.pop(ready)
        lost = self._ray.exceptions.RayActorError, self._ray.exceptions.ObjectLostError
        try:
            answer: str | list[Event] | None = answer_of(self._ray, ready)
        except lost as error:
            return self._replace(slot, scheduler, error)
        if answer is None:  # it has begun
            self._calls[self._actors[slot].node.remote()] = slot
            return []
        self._stillborn = 0
        if isinstance(answer, str):
            self._nodes[slot] = answer
            return []
        for event in answer:
            scheduler.record(slot, event)
        return answer

    def _next_answer(self) -> Any:
        """Of any actor. Says once in a while that there is none to wait for, instead of waiting in silence."""
        while True:
            ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=PATIENCE)
            if ready:
                return ready[0]
            if not self._nodes:
                free = {name: self._ray.available_resources().get(name, 0) for name in ("CPU", "GPU")}
                warnings.warn(
                    f"no worker on the Ray cluster has begun within {PATIENCE:.0f} s: each needs a core"
                    f"{' and a GPU' if self._on_gpu else ''}, and the cluster has "
                    f"{free['CPU']:g} cores and {free['GPU']:g} GPUs free. It still loads the model, or waits for "
                    "a node: `ray status` shows which",
                    ClusterFullWarning,
                    stacklevel=2,
                )

    def _replace(self, slot: int, scheduler: Scheduler, error: Exception) -> list[Event]:
        self._ray.kill(self._actors[slot])  # it may live on behind a broken network
        node = self._nodes.pop(slot, None)
        # Until Ray knows of a lost node it puts workers there that never run, as many as were lost with it.
        self._stillborn += node is None and self._seen[slot] <= self._alive()
        if self._stillborn >= STILLBORN:
            raise WorkerDiedError(
                f"{STILLBORN} workers in a row died on the Ray cluster before their first episode; the last one: "
                f"{error}. Look at the nodes' memory, or leave out --ray to see the error in this process"
            )
        self._start(slot)
        events = self._committed(scheduler.holds(slot))
        for event in events:
            scheduler.record(slot, event)
        where = "that had not begun yet" if node is None else f"on node {node}"
        why = " ".join(line for line in str(error).splitlines() if not line.startswith("\t"))  # but Ray's numbers
        tell_lost(f"a worker {where} of the Ray cluster is lost: {why}", len(scheduler.holds(slot)))
        return [*events, *scheduler.lose(slot, f"its Ray actor died: {error}")]

    def _committed(self, numbers: set[int]) -> list[Event]:
        """What a dead actor finished before it could say so."""
        root = read_root(locate(self._run))
        finished = [(number, commit_key(number)) for number in sorted(numbers)]
        finished = [(number, key) for number, key in finished if root.location.exists(key)]
        commits = [read_commit(root, number, key, root.location.read(key)) for number, key in finished]
        return [Done(commit["episode"], commit["outcome"]) for commit in commits]
