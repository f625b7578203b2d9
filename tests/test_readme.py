"""What the README shows works as it stands."""

import contextlib
import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.parametrize("steps", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_the_python_example_runs(steps: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As it stands in the slow suite; in the default one its episodes end after one inference."""
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert "max_steps=20" in example
    example = example.replace("max_steps=20", f"max_steps={steps}")
    with contextlib.chdir(tmp_path):
        exec(compile(example, "README", "exec"), {"__name__": "__main__"})
    assert "(24, 96) float32" in capsys.readouterr().out
    assert (tmp_path / "layer-curves.png").stat().st_size > 10_000


def test_every_page_and_picture_it_points_to_is_there() -> None:
    root = Path(__file__).parents[1]
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (root / link).is_file()] == []
