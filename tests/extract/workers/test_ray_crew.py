"""What a crew on Ray does when nodes are lost or full, against a stand-in for Ray that decides who lives.

That real actors and nodes behave as the stand-in does is what `tests/extract/test_ray.py` tests (slow).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from probe_kit.errors import UnknownModelError, WorkerDiedError
from probe_kit.extract.rollout.events import Done, Event
from probe_kit.extract.workers import ray as crew
from probe_kit.extract.workers.ray import ClusterFullWarning, run_on_ray
from probe_kit.extract.workers.scheduler import Scheduler
from probe_kit.extract.workers.worker_errors import WorkerLostWarning
from probe_kit.runs.store import locate
from probe_kit.suite import Suite
from tests.support.little_run import little_plan, little_writer

EPISODES = 40


class ActorDiedError(Exception):
    """As Ray raises it."""


@dataclass(eq=False)
class Actor:
    """One that runs where there is room; its calls are answered in order."""

    cluster: "Cluster"
    running: bool = False
    dead: bool = False

    def call(self, name: str, *arguments: Any) -> "Call":
        made = Call(self, name, arguments)
        self.cluster.calls.append(made)
        return made

    def __getattr__(self, name: str) -> Any:
        return SimpleNamespace(remote=lambda *arguments: self.call(name, *arguments))


@dataclass(eq=False)
class Call:
    actor: Actor
    name: str
    arguments: tuple[Any, ...]


@dataclass
class Cluster:
    """room: actors that can run at a time. dies: of each due call, whether its actor dies with it.

    begins_with: what workers answer to `begin` if anything is wrong. alive: names of its nodes.
    """

    room: int
    dies: Callable[["Cluster", Call], bool]
    begins_with: Any = None
    alive: set[str] = field(default_factory=lambda: {"first", "second"})
    actors: list[Actor] = field(default_factory=list)
    calls: list[Call] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)
    waited_in_vain: int = 0
    exceptions: Any = field(
        default_factory=lambda: SimpleNamespace(RayActorError=ActorDiedError, ObjectLostError=ActorDiedError)
    )

    def remote(self, **options: Any) -> Callable[[type], Any]:
        self.options = options
        return lambda _kind: SimpleNamespace(remote=self._start)

    def _start(self, *_: Any) -> Actor:
        self.actors.append(Actor(self))
        self._fill()
        return self.actors[-1]

    def _fill(self) -> None:
        for actor in self.actors:
            if not actor.running and not actor.dead and sum(one.running for one in self.actors) < self.room:
                actor.running = True

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
            if ref.actor.running or ref.actor.dead:
                return [ref], [one for one in refs if one is not ref]
        self.waited_in_vain += 1
        assert self.waited_in_vain < 5, "it waits for what never comes"
        self.room += 1  # a node joins
        self._fill()
        return [], refs

    def get(self, ref: Call) -> Any:
        if not ref.actor.dead and self.dies(self, ref):
            self.kill(ref.actor)
        if ref.actor.dead:
            raise ActorDiedError(f"in {ref.name}")
        if ref.name == "begin":
            return self.begins_with
        if ref.name == "node":
            return "first"
        return [Done(n, {"outcome": "oob"}) for n in ref.arguments[0]]

    def kill(self, actor: Actor) -> None:
        actor.running, actor.dead = False, True
        self._fill()


@pytest.fixture
def run(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[Scheduler, list[Event]]]:
    little_writer(locate(tmp_path / "run"), little_plan(small_suite))

    def play(cluster: Cluster, workers: int) -> tuple[Scheduler, list[Event]]:
        @contextmanager
        def connected(_address: str, log_to_driver: bool) -> Iterator[Cluster]:
            assert log_to_driver
            yield cluster

        monkeypatch.setattr(crew, "ray_cluster", connected)
        scheduler, captured = Scheduler(range(EPISODES)), list[Event]()
        settings: Any = SimpleNamespace(workers=workers, ray="a cluster", device="cpu")
        run_on_ray(settings, str(tmp_path / "run"), scheduler, captured.append)
        assert all(actor.dead for actor in cluster.actors), "none outlives the extraction"
        return scheduler, captured

    return play


def test_a_lost_node_whose_worker_finds_no_room_again_holds_nobody_up(run: Any) -> None:
    def dies(cluster: Cluster, call: Call) -> bool:
        lost = call.name == "play" and cluster.room == 2
        cluster.room -= lost
        return lost

    cluster = Cluster(2, dies)
    with pytest.warns(
        WorkerLostWarning, match=r"on node first .* is lost: in play; 8 episodes it held are played"
    ):
        scheduler, captured = run(cluster, 2)
    assert scheduler.done == set(range(EPISODES))
    assert not scheduler.given_up
    assert sorted(event.number for event in captured if isinstance(event, Done)) == list(range(EPISODES))
    assert len(cluster.actors) == 3
    played = {call.actor for call in cluster.calls if call.name == "play"}
    assert len(played) == 2, "the third never ran, and was given nothing to play"


def test_workers_that_ray_puts_on_a_lost_node_before_it_knows_are_no_reason_to_end(run: Any) -> None:
    lost, workers = range(4), 8

    def dies(cluster: Cluster, call: Call) -> bool:
        number = cluster.actors.index(call.actor)
        never_ran = call.name == "begin" and number in range(workers, workers + len(lost))
        if never_ran:
            cluster.alive.discard("second")
        return never_ran or (call.name == "play" and number in lost)

    cluster = Cluster(workers, dies)
    with pytest.warns(WorkerLostWarning):
        scheduler, _ = run(cluster, workers)
    assert scheduler.done == set(range(EPISODES))
    assert len(cluster.actors) == workers + 2 * len(lost)


def test_workers_are_spread_and_hold_a_core(run: Any) -> None:
    cluster = Cluster(2, lambda _cluster, _call: False)
    run(cluster, 4)
    assert (cluster.options["num_cpus"], cluster.options["scheduling_strategy"]) == (1, "SPREAD")
    assert {call.actor.running for call in cluster.calls} == {False}


def test_workers_that_die_before_they_begin_end_the_extraction(run: Any) -> None:
    with (
        pytest.raises(WorkerDiedError, match="3 workers in a row died on the Ray cluster"),
        pytest.warns(
            WorkerLostWarning, match="that had not begun yet of the Ray cluster is lost: in begin; it held no"
        ),
    ):
        run(Cluster(2, lambda _cluster, call: call.name == "begin"), 2)


def test_what_is_wrong_with_the_run_is_raised_as_it_is(run: Any) -> None:
    with pytest.raises(UnknownModelError, match="nothing there"):
        run(Cluster(2, lambda _cluster, _call: False, begins_with=UnknownModelError("nothing there")), 2)


def test_a_cluster_without_room_is_not_waited_for_in_silence(run: Any) -> None:
    cluster = Cluster(0, lambda _cluster, _call: False)
    with pytest.warns(ClusterFullWarning, match="each needs a core, and the cluster has 0 cores"):
        scheduler, _ = run(cluster, 2)
    assert scheduler.done == set(range(EPISODES))


def test_an_episode_that_kills_two_workers_is_given_up(run: Any) -> None:
    cluster = Cluster(2, lambda _cluster, call: call.name == "play" and 7 in call.arguments[0])
    with pytest.warns(WorkerLostWarning):
        scheduler, _ = run(cluster, 2)
    assert set(scheduler.given_up) == {7}
    assert scheduler.done == set(range(EPISODES)) - {7}
