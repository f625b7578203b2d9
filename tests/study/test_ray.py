"""A study on a Ray cluster of two nodes, one of which is lost."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit._system.imports import install_command
from probe_kit.errors import MissingExtraError
from probe_kit.runs.layout import COMMITS
from probe_kit.study import conduct_study, load_study, plan_study
from probe_kit.suite import Suite
from tests.extract.two_nodes import TwoNodes, two_nodes, wait_for
from tests.study.small_study import check_same_bytes, run_folders, small_study


def test_without_ray_the_error_names_the_extra(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingExtraError) as caught:
        conduct_study(plan_study(load_study(small_study(tmp_path, small_suite))), ray="auto")
    assert install_command("ray") in str(caught.value)


@pytest.mark.slow
def test_two_nodes_of_which_one_is_lost_give_the_numbers_of_this_process(
    small_suite: Suite, tmp_path: Path
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    local_study, remote_study = (
        small_study(tmp_path / "here", small_suite),
        small_study(tmp_path / "there", small_suite),
    )
    assert conduct_study(plan_study(load_study(local_study))) == []

    def lose(nodes: TwoNodes) -> int:
        wait_for(lambda: nodes.is_playing() and _committed(remote_study))
        nodes.lose_the_second()
        return _committed(remote_study)

    with two_nodes() as nodes, ThreadPoolExecutor(1) as thread:
        committed = thread.submit(lose, nodes)
        # The lost worker may still wait for its first model, while the one on the other node plays.
        with pytest.warns(
            WorkerLostWarning, match=r"of the Ray cluster.* is lost: .*; (the model it held|it held no)"
        ):
            assert conduct_study(plan_study(load_study(remote_study)), ray=nodes.address) == []
    assert 0 < committed.result() < 4 * 24
    check_same_bytes(remote_study, local_study)


def _committed(file: Path) -> int:
    return sum(len(list((folder / COMMITS).glob("*.json"))) for folder in run_folders(file))
