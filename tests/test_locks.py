"""`pyproject.toml` and the locks say the same, and the lock for running is enough to run."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALL = (ROOT / "requirements" / "install.py").read_text(encoding="utf-8")


def locked(name: str) -> dict[str, str]:
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    lines = [Requirement(line) for line in text.splitlines() if line and not line.startswith("#")]
    return {canonicalize_name(line.name): next(iter(line.specifier)).version for line in lines}


def torch() -> dict[str, str]:
    return dict(re.findall(r'"(torch)==([\d.]+)"', INSTALL))


def needed(requirements: list[str]) -> set[str]:
    """The requirements and all that they require, as installed here."""
    seen: set[tuple[str, frozenset[str]]] = set()
    todo = [(Requirement(text), frozenset({""})) for text in requirements]
    while todo:
        requirement, extras = todo.pop()
        if requirement.marker and not any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        name = canonicalize_name(requirement.name)
        if (name, frozenset(requirement.extras)) not in seen:
            seen.add((name, frozenset(requirement.extras)))
            further = metadata.distribution(name).requires or []
            todo += [(Requirement(text), frozenset({"", *requirement.extras})) for text in further]
    return {name for name, _ in seen}


def test_the_lock_for_running_holds_all_that_the_product_requires() -> None:
    assert needed(PROJECT["dependencies"]) - {"setuptools"} <= locked("run.lock").keys() | torch().keys()


def test_no_package_is_in_both_locks() -> None:
    assert not locked("run.lock").keys() & locked("dev.lock").keys()


@pytest.mark.parametrize("extra", ["", *PROJECT["optional-dependencies"]])
def test_what_is_locked_is_what_the_project_asks_for(extra: str) -> None:
    every = {**locked("run.lock"), **locked("dev.lock"), **torch()}
    asked = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    for requirement in map(Requirement, asked):
        name = canonicalize_name(requirement.name)
        if name == "gcsfs":  # not locked: nothing here can try it
            continue
        assert requirement.specifier.contains(every[name]), requirement


def test_what_is_installed_here_is_what_is_locked() -> None:
    for name, version in {**locked("run.lock"), **locked("dev.lock")}.items():
        if name not in {"setuptools", "pyaubo-sdk"}:  # not needed or not offered for every Python
            assert metadata.version(name) == version, name
