from probe_kit.extract.workers.scheduler import Done, Failed, Scheduler


def done(number: int) -> Done:
    return Done(number, {})


def test_every_episode_is_handed_out_once_in_order() -> None:
    scheduler = Scheduler([3, 1, 2])
    assert [scheduler.take(0), scheduler.take(1), scheduler.take(0), scheduler.take(0)] == [3, 1, 2, None]
    assert not scheduler.finished
    for worker, number in ((0, 3), (1, 1), (0, 2)):
        scheduler.record(worker, done(number))
    assert scheduler.finished


def test_a_suspect_is_tried_once_more_and_alone() -> None:
    scheduler = Scheduler([0, 1])
    scheduler.take(0), scheduler.take(0)
    scheduler.record(0, Failed(0, "broke"))
    assert scheduler.take(0) is None, "worker 0 still holds episode 1"
    scheduler.record(0, done(1))
    assert scheduler.take(0) == 0
    assert scheduler.take(0) is None, "nothing beside a suspect"
    scheduler.record(0, Failed(0, "broke again"))
    assert scheduler.given_up == {0: Failed(0, "broke again")}
    assert scheduler.finished


def test_a_worker_that_dies_costs_no_episode_that_would_have_worked() -> None:
    scheduler = Scheduler([0, 1, 2])
    held = [scheduler.take(7), scheduler.take(7)]
    assert [event.number for event in scheduler.lose(7, "killed")] == held
    played = []
    while (number := scheduler.take(8)) is not None:
        scheduler.record(8, done(number))
        played.append(number)
    assert played == [2, 0, 1]
    assert scheduler.finished
    assert not scheduler.given_up
