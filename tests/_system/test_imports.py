"""The packages that hold each module are those that Python's own scan of the disk finds."""

from importlib import metadata
from pathlib import Path

import pytest

from probe_kit._system.imports import one_scan_of_packages, packages_by_module


@pytest.mark.slow
def test_modules_belong_to_the_packages_that_the_standard_library_names() -> None:
    expected = {module: set(packages) for module, packages in metadata.packages_distributions().items()}
    assert {module: set(packages) for module, packages in packages_by_module().items()} == expected


def test_imports_of_a_block_share_one_scan_and_the_standard_one_is_back_afterwards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scans = []

    def scan() -> dict[str, list[str]]:
        scans.append(1)
        return {"numpy": ["numpy"]}

    monkeypatch.setattr("probe_kit._system.imports.packages_by_module", scan)
    before = metadata.packages_distributions
    with one_scan_of_packages():
        first, second = metadata.packages_distributions(), metadata.packages_distributions()
    assert first == second == {"numpy": ["numpy"]}
    assert len(scans) == 1
    assert metadata.packages_distributions is before


def test_modules_are_read_from_the_list_of_files_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package, files in {"listed": 'listed_module.py,,\n"listed/with, comma.py",,\n', "listless": None}.items():
        folder = tmp_path / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8"
        )
        if files is not None:
            (folder / "RECORD").write_text(f"{files}{folder.name}/METADATA,,\n", encoding="utf-8")
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    assert packages_by_module() == {"listed_module": ["listed"], "listed": ["listed"]}
