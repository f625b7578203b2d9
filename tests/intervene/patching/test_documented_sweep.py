"""The sweep of `docs/causal.md` runs as it stands there, on a run of the embedded policy."""

import re
from pathlib import Path

import pytest

import probe_kit as pk

PAGE = Path(__file__).parents[3] / "docs" / "causal.md"


@pytest.mark.slow
def test_the_sweep_of_the_page_finds_where_the_embedded_policy_reads_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = (
        block_of_code
        for block_of_code in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
        if "pt." in block_of_code
    )
    monkeypatch.chdir(tmp_path)
    scene = pk.SceneSpec(max_steps=4)
    pk.extract_run(pk.ExtractSettings("pi0-tiny", categories=("color",), items=24, scene=scene), "runs/pi0")
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    swept = names["swept"]
    assert isinstance(swept, pk.patching.Sweep)
    share = swept.table.set_index("cells")["share"]
    assert share["backbone.00 all"] == pytest.approx(1, abs=1e-6)
    assert share["kv.02 image"] > 0.95
    assert (
        share[["kv.00 image", "kv.00 language", "kv.01 image", "kv.01 language", "kv.02 language"]].abs().max()
        < 0.05
    )
    assert share["backbone.03 all"] == 0, "the end of the backbone is unread"
    printed = capsys.readouterr().out
    assert "kv.02" in printed
    void = re.search(r"screen void: gradients give (-?0\.\d\d) where the patch gives 1\.00", printed)
    assert void is not None
    assert abs(float(void[1])) < 0.05, "a decision that is made has no slope"
    assert (tmp_path / "sweep.svg").stat().st_size > 1000
