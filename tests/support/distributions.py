"""Distributions of third parties, as an installer would leave them: modules, and metadata with an entry point."""

import shutil
from pathlib import Path

GROUP = "probe_kit.policies"


def install(folder: Path, name: str, target: str, *sources: Path) -> Path:
    """A folder for `PYTHONPATH` with the family `name` at `target`; `sources` are modules or packages to copy."""
    module = name.replace("-", "_")
    info = folder / f"{module}-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {target}\n", encoding="utf-8")
    for source in sources:
        copy = shutil.copytree if source.is_dir() else shutil.copyfile
        copy(source, folder / source.name)
    return folder


def install_encoder_vla(folder: Path) -> Path:
    """The family `encoder-vla` of `tests/support`, as a distribution of its own."""
    return install(folder, "encoder-vla", "encoder_vla:FAMILY", Path(__file__).parent / "encoder_vla")
