import sys
from pathlib import Path
from subprocess import run

import numpy as np
import pybullet
import pytest

from probe_kit.env.bullet import BulletClient


def test_this_pybullet_was_compiled_with_numpy():
    assert pybullet.isNumpyEnabled()


def test_a_pybullet_without_numpy_is_announced_with_its_remedy(monkeypatch):
    monkeypatch.setattr(pybullet, "isNumpyEnabled", lambda: 0)
    with pytest.warns(UserWarning, match="--no-build-isolation"):
        BulletClient().close()


def test_two_clients_do_not_see_each_others_bodies():
    one, other = BulletClient(), BulletClient()
    one.createMultiBody(1.0)
    assert (one.getNumBodies(), other.getNumBodies()) == (1, 0)
    one.close()
    other.close()


def test_closing_twice_is_fine_and_spares_the_others():
    one, other = BulletClient(), BulletClient()
    one.close()
    one.close()
    assert other.getNumBodies() == 0
    other.close()


def test_making_an_environment_loads_neither_the_simulator_nor_torch():
    code = (
        "import sys, probe_kit.env; probe_kit.env.Act2AnswerEnv(); "
        "print({'pybullet', 'torch', 'lerobot'} & set(sys.modules))"
    )
    root = Path(__file__).parents[2]
    assert run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root).stdout.strip() == "set()"


def test_pictures_arrive_as_arrays():
    client = BulletClient()
    picture = client.getCameraImage(4, 4, renderer=client.ER_TINY_RENDERER)[2]
    assert isinstance(picture, np.ndarray)
    client.close()
