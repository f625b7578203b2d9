"""What the README shows works as it stands."""

import contextlib
import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_python_example_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    with contextlib.chdir(tmp_path):
        exec(compile(example, "README", "exec"), {"__name__": "__main__"})
    assert "(24, 96) float32" in capsys.readouterr().out
    assert (tmp_path / "layer-curves.png").stat().st_size > 10_000


def test_every_page_and_picture_it_points_to_is_there() -> None:
    root = Path(__file__).parents[1]
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (root / link).is_file()] == []


def test_the_first_screen_up_to_the_picture_and_its_caption_is_short() -> None:
    picture = re.search(r"!\[[^]]*\]\([^)]*\)\s+\*.*?\*\n\n", README, re.DOTALL)
    assert picture is not None
    assert len(README[: picture.end()].split()) <= 400


def test_the_lines_of_a_study_name_nothing_that_a_fresh_checkout_lacks() -> None:
    """They are typed by tests/test_documented_commands.py."""
    (lines,) = re.findall(r"## Your own study\n\n```\n(.*?)```", README, re.DOTALL)
    assert not re.search(r"\b[A-Z]{3,}\b", lines), "a word in capitals is to be replaced by the reader"
    assert "--model pi0-tiny" in lines
