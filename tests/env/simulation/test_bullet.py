import re
import sys
from pathlib import Path
from subprocess import run

import numpy as np
import pybullet
import pytest

from probe_kit._system.imports import install_command
from probe_kit.env.simulation import BulletClient


def test_this_pybullet_was_compiled_with_numpy():
    assert pybullet.isNumpyEnabled()


def test_a_pybullet_without_numpy_is_announced_with_its_remedy(monkeypatch):
    monkeypatch.setattr(pybullet, "isNumpyEnabled", lambda: 0)
    with pytest.warns(UserWarning, match=re.escape(install_command(rebuild="pybullet"))):
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
    root = Path(__file__).parents[3]
    assert (
        run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", cwd=root).stdout.strip()
        == "set()"
    )


def test_pictures_arrive_as_arrays():
    client = BulletClient()
    picture = client.getCameraImage(4, 4, renderer=client.ER_TINY_RENDERER)[2]
    assert isinstance(picture, np.ndarray)
    client.close()


SIMULATES = "from probe_kit.env import Act2AnswerEnv; env = Act2AnswerEnv(); env.reset(seed=0); env.close()"


def test_the_simulator_starts_in_silence_on_both_streams():
    done = run([sys.executable, "-c", SIMULATES], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_what_others_say_while_it_is_imported_is_passed_on(tmp_path):
    (tmp_path / "pybullet.py").write_text(
        "import os, sys\nos.write(2, b'pybullet build time: today\\nby C\\n')\nsys.stderr.write('by Python\\n')\n",
        encoding="utf-8",
    )
    code = "from probe_kit.env.simulation import import_pybullet as load; load(); load()"
    done = run([sys.executable, "-c", code], capture_output=True, check=True, env={"PYTHONPATH": str(tmp_path)})
    assert done.stderr == b"by C\nby Python\n"


def test_it_can_be_imported_by_a_process_without_stderr():
    code = (
        "import os; os.close(2); from probe_kit.env.simulation import BulletClient; BulletClient(); print('there')"
    )
    assert run([sys.executable, "-c", code], stdout=-1, check=True).stdout == b"there\n"


def test_pybullet_is_imported_in_one_place():
    package = Path(__file__).parents[3] / "probe_kit"
    importing = re.compile(r"^\s*(import pybullet\b|from pybullet\b)", re.MULTILINE)
    assert [path for path in package.rglob("*.py") if importing.search(path.read_text(encoding="utf-8"))] == []
