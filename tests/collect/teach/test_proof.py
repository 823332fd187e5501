"""The proof: what lets the arm move, how fast, and where its recording is kept."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from brushloop.collect.errors import CannotTeach, ConfigError
from brushloop.collect.operator import Choice
from brushloop.collect.rig.config import load_rig
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Shown
from brushloop.collect.teach.steps import proof
from brushloop.collect.teach.steps.proof import ProofStep, folder_beside, slowly
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml


def test_each_proof_is_recorded_in_a_new_folder_beside_the_rig(tmp_path: Path) -> None:
    rig = tmp_path / "lab.toml"
    first, second = folder_beside(rig), folder_beside(rig)
    assert [first.name, second.name] == ["lab.proof-1", "lab.proof-2"]
    assert first.is_dir()
    assert second.is_dir()


class Refusing:
    """A person who leaves the arm where it is."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def show(self, what: Shown) -> None:
        pass

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
        self.asked.append(question)
        return default


@pytest.mark.parametrize(("armed", "said"), [(False, "with --arm"), (True, "left where it is")])
async def test_the_proof_runs_nothing_without_the_command_line_and_the_operators_key(
    armed: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def no_run(*_: object, **__: object) -> Path:
        raise AssertionError("the arm would have moved")

    async def answered(*_: object) -> None:
        pass

    monkeypatch.setattr(ProofStep, "_run", no_run)
    monkeypatch.setattr(ProofStep, "_doctor", answered)
    monkeypatch.setattr(proof, "rig_of", lambda *_: SimpleNamespace(brush=SimpleNamespace(max_depth_mm=22.0)))
    person = Refusing()
    with pytest.raises(CannotTeach, match=said):
        await ProofStep().teach(Day(person, tmp_path / "rig.toml", HostClock(), armed=armed))  # type: ignore[arg-type]
    assert len(person.asked) == armed
    assert all("The arm moves by itself, slower than 50 mm/s" in question for question in person.asked)


@pytest.mark.parametrize("dry", [True, False])
async def test_every_pose_of_the_proof_is_checked_before_the_arm_is_connected(
    dry: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_engine(*_: object, **__: object) -> None:
        raise AssertionError("the arm would have moved")

    text = rig_toml(SimConfig(), Addresses("127.0.0.1", 30004, 30010, 8080, 28700, "/dev/ttyUSB0"))
    low = re.sub(r"(?m)^z_mm = \[.*", "z_mm = [98.0, 170.0]", text, count=1)  # travel height is 180
    monkeypatch.setattr(proof, "_with_lens_at", lambda _: low)
    monkeypatch.setattr(proof, "DryRunEngine" if dry else "Engine", no_engine)
    day = Day(Refusing(), tmp_path / "rig.toml", HostClock(), armed=True)  # type: ignore[arg-type]
    protocol = 'kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 2\n'
    with pytest.raises(ConfigError, match=r"robot\.limits: a planned pose is outside the limits: z = "):
        await ProofStep()._run(day, tmp_path, protocol, dry=dry)


def test_every_move_of_the_proof_is_slower_than_50_mm_s(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 30004, 30010, 8080, 28700, "/dev/ttyUSB0")))
    rig = load_rig(path)
    slow = slowly(rig)
    assert rig.motion.travel_speed_mm_s > 50.0, "otherwise faster"
    assert max(slow.motion.travel_speed_mm_s, slow.motion.press_speed_mm_s) < 50.0
    assert slow.robot.limits.speed_mm_s <= 50.0, "the driver refuses more"
