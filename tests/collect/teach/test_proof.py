"""The proof's recording: kept beside `rig.toml`, each in a folder of its own."""

from __future__ import annotations

from pathlib import Path

from collect.teach.steps.proof import folder_beside


def test_each_proof_is_recorded_in_a_new_folder_beside_the_rig(tmp_path: Path) -> None:
    rig = tmp_path / "lab.toml"
    first, second = folder_beside(rig), folder_beside(rig)
    assert [first.name, second.name] == ["lab.proof-1", "lab.proof-2"]
    assert first.is_dir()
    assert second.is_dir()
