"""Workers on Ray when nodes are lost or full, against a stand-in for Ray that decides who lives.

That real actors and nodes behave as the stand-in does is what `tests/extract/test_ray.py` tests (slow).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from probe_kit._execution import ray_pool
from probe_kit._execution.executor import GivenUp, IdleMessage, TaskQueue, WorkerLostWarning, work_off
from probe_kit._execution.ray_pool import ClusterFullWarning, RayPool
from probe_kit.errors import UnknownModelError, WorkerDiedError

TASKS = 40


class ActorDiedError(Exception):
    """As Ray raises it."""


@dataclass(eq=False)
class Actor:
    """One that runs where there is room. It waits for a task first, then reports and waits after every one."""

    cluster: "Cluster"
    gpus: int
    running: bool = False
    dead: bool = False
    reports: list[Any] = field(default_factory=lambda: [IdleMessage()])
    tasks: list[Any] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return SimpleNamespace(remote=lambda *arguments: getattr(self, f"_{name}")(*arguments))

    def _work(self) -> None:
        if self.cluster.first_report is not None:
            self.reports = [self.cluster.first_report]

    def _give(self, task: Any) -> None:
        self.tasks.append(task)
        self.reports += [task, IdleMessage()]

    def _collect(self) -> "Call":
        return Call(self)


@dataclass(eq=False)
class Call:
    actor: Actor


@dataclass
class Cluster:
    """room: actors that can run at a time. dies: of each actor with something to report, whether it dies first.

    first_report: instead of `IdleMessage`. alive: names of its nodes.
    """

    room: int
    dies: Callable[["Cluster", Actor], bool] = lambda _cluster, _actor: False
    first_report: Any = None
    alive: set[str] = field(default_factory=lambda: {"first", "second"})
    actors: list[Actor] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)
    waited_in_vain: int = 0
    exceptions: Any = field(
        default_factory=lambda: SimpleNamespace(RayActorError=ActorDiedError, ObjectLostError=ActorDiedError)
    )

    def remote(self, **options: Any) -> Callable[[type], Any]:
        self.options = options
        return lambda _kind: SimpleNamespace(
            options=lambda num_gpus: SimpleNamespace(remote=self._start(num_gpus))
        )

    def _start(self, gpus: int) -> Callable[..., Actor]:
        def start(_content: Any) -> Actor:
            self.actors.append(Actor(self, gpus))
            self._fill()
            return self.actors[-1]

        return start

    def _fill(self) -> None:
        for actor in self.actors:
            if not actor.running and not actor.dead and sum(worker.running for worker in self.actors) < self.room:
                actor.running = True

    def put(self, content: Any) -> Any:
        return content

    def nodes(self) -> list[dict[str, Any]]:
        return [{"NodeID": name, "Alive": name in self.alive} for name in ("first", "second")]

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.room}

    def available_resources(self) -> dict[str, float]:
        return {}

    def wait(self, refs: list[Call], num_returns: int, timeout: float) -> tuple[list[Call], list[Call]]:
        assert num_returns == 1
        assert timeout > 0, "a wait without end says nothing"
        for ref in refs:
            if (ref.actor.running and ref.actor.reports) or ref.actor.dead:
                return [ref], [other for other in refs if other is not ref]
        self.waited_in_vain += 1
        assert self.waited_in_vain < 5, "it waits for what never comes"
        self.room += 1  # a node joins
        self._fill()
        return [], refs

    def get(self, ref: Call) -> tuple[str, list[Any]]:
        actor = ref.actor
        if not actor.dead and self.dies(self, actor):
            self.kill(actor)
        if actor.dead:
            raise ActorDiedError("The actor died.\n\tclass_name: RayWorker")
        reports, actor.reports = actor.reports, []
        return "first", reports

    def kill(self, actor: Actor) -> None:
        actor.running, actor.dead = False, True
        self._fill()


@pytest.fixture
def done_on(monkeypatch: pytest.MonkeyPatch) -> Callable[[Cluster, int], tuple[list[int], list[GivenUp[int]]]]:
    def play(cluster: Cluster, workers: int) -> tuple[list[int], list[GivenUp[int]]]:
        @contextmanager
        def connected(_address: str) -> Iterator[Cluster]:
            yield cluster

        monkeypatch.setattr(ray_pool, "ray_cluster", connected)
        queue = TaskQueue(((number, number) for number in range(TASKS)), "episode")
        completed: list[int] = []
        given_up: list[GivenUp[int]] = []
        pool = RayPool(lambda *_: None, None, "a cluster", lambda _resources: [0] * workers)
        for slot, event in work_off(pool, queue):
            if isinstance(event, GivenUp):
                given_up.append(event)
            else:
                queue.end(slot, event)
                completed.append(event)
        assert all(actor.dead for actor in cluster.actors), "none outlives the work"
        return completed, given_up

    return play


def begun(actor: Actor) -> bool:
    return bool(actor.tasks)


def test_a_lost_node_whose_worker_finds_no_room_again_holds_nobody_up(done_on: Any) -> None:
    def dies(cluster: Cluster, actor: Actor) -> bool:
        lost = begun(actor) and cluster.room == 2
        cluster.room -= lost
        return lost

    cluster = Cluster(2, dies)
    with pytest.warns(
        WorkerLostWarning, match=r"on node first of the Ray cluster is lost: The actor died\.; the episode it held"
    ):
        completed, given_up = done_on(cluster, 2)
    assert sorted(completed) == list(range(TASKS))
    assert not given_up
    assert len(cluster.actors) == 3
    assert not begun(cluster.actors[2]), "the third never ran, and was given nothing to do"


def test_workers_that_ray_puts_on_a_lost_node_before_it_knows_are_no_reason_to_end(done_on: Any) -> None:
    lost, workers = range(4), 8

    def dies(cluster: Cluster, actor: Actor) -> bool:
        number = cluster.actors.index(actor)
        never_ran = not begun(actor) and number in range(workers, workers + len(lost))
        if never_ran:
            cluster.alive.discard("second")
        return never_ran or (begun(actor) and number in lost)

    cluster = Cluster(workers, dies)
    with pytest.warns(WorkerLostWarning):
        completed, _ = done_on(cluster, workers)
    assert sorted(completed) == list(range(TASKS))
    assert len(cluster.actors) == workers + 2 * len(lost)


def test_workers_are_spread_and_hold_a_core(done_on: Any) -> None:
    cluster = Cluster(2)
    done_on(cluster, 4)
    assert (cluster.options["num_cpus"], cluster.options["scheduling_strategy"]) == (1, "SPREAD")


def test_workers_that_die_before_they_begin_end_the_work(done_on: Any) -> None:
    with (
        pytest.raises(WorkerDiedError, match="3 workers in a row ended before their first task"),
        pytest.warns(WorkerLostWarning, match="of the Ray cluster that had not begun is lost"),
    ):
        done_on(Cluster(2, lambda _cluster, actor: not begun(actor)), 2)


def test_an_error_of_a_worker_is_raised_as_it_is(done_on: Any) -> None:
    with pytest.raises(UnknownModelError, match="nothing there"):
        done_on(Cluster(2, first_report=UnknownModelError("nothing there")), 2)


def test_a_cluster_without_room_is_not_waited_for_in_silence(done_on: Any) -> None:
    with pytest.warns(ClusterFullWarning, match="each needs a core, and the cluster has 0 cores"):
        completed, _ = done_on(Cluster(0), 2)
    assert sorted(completed) == list(range(TASKS))


def test_a_task_that_kills_two_workers_is_given_up(done_on: Any) -> None:
    cluster = Cluster(2, lambda _cluster, actor: actor.tasks[-1:] == [7])
    with pytest.warns(WorkerLostWarning):
        completed, given_up = done_on(cluster, 2)
    assert [event.task for event in given_up] == [7]
    assert sorted(completed) == [number for number in range(TASKS) if number != 7]
