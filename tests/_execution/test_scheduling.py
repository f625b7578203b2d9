"""Libraries change how the system schedules this process; probe_kit puts it back."""

import os
from pathlib import Path

import pytest

from probe_kit._execution.scheduling import same_scheduling

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no scheduling policies here")


@pytest.mark.parametrize("fails", [False, True])
def test_a_thread_that_a_library_makes_a_batch_one_is_normal_again(fails: bool) -> None:
    policy = os.sched_getscheduler(0)
    try:
        with same_scheduling():
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
            if fails:
                raise KeyError
    except KeyError:
        pass
    assert os.sched_getscheduler(0) == policy


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only of root")
@pytest.mark.filterwarnings("ignore")
def test_encoding_av1_makes_a_thread_of_root_a_real_time_one_otherwise(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with same_scheduling():
        with av.open(str(tmp_path / "film.mp4"), "w") as film:
            stream = film.add_stream("libsvtav1", 5, width=64, height=64, pix_fmt="yuv420p")
            film.mux(stream.encode(av.VideoFrame(64, 64, "yuv420p")) + stream.encode())
        during = os.sched_getscheduler(0)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    if during == os.SCHED_OTHER:
        pytest.skip("this machine gives no thread real time")
