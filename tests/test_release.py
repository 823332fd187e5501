"""What is released works without the repository, completes in shells, and is locked as the project asks."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.blocks import ROOT, blocks_of


def run(*command: object, cwd: Path, **environment: str) -> str:
    """Run a command to its end and return its output; PYTHONPATH and the like are not passed on."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    words = [str(word) for word in command]
    ran = subprocess.run(words, cwd=cwd, env=kept | environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, f"{words}\n{ran.stdout}{ran.stderr}"
    return ran.stdout


@pytest.fixture(scope="module")
def brushloop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of an environment with the wheel, built from the source archive; packages are those of this one."""
    folder = tmp_path_factory.mktemp("release")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    [archive] = folder.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
    source = folder / archive.name.removesuffix(".tar.gz")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=source)
    [wheel] = folder.glob("*.whl")
    venv.create(folder / "clean", with_pip=False)
    [packages] = (folder / "clean" / "lib").glob("python*/site-packages")
    # A path in a .pth file is searched, but its own .pth files, such as that of an editable installation, are not read.
    (packages / "here.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")) + "\n")
    python = folder / "clean" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--ignore-installed", wheel, cwd=folder)
    where = run(python, "-c", "import brushloop; print(brushloop.__file__)", cwd=folder).strip()
    assert Path(where).is_relative_to(packages), "the wheel's, not the repository's"
    return folder / "clean" / "bin" / "brushloop"


@pytest.fixture
def command() -> Path:
    """The command beside this Python."""
    path = Path(sys.executable).with_name("brushloop")
    if not path.is_file():
        pytest.skip("brushloop is not installed beside this Python")
    return path


def test_a_shell_is_given_what_completes_a_command(command: Path, tmp_path: Path) -> None:
    typed = {"COMP_WORDS": "brushloop sess", "COMP_CWORD": "1"}
    assert "sessions" in run(command, cwd=tmp_path, _BRUSHLOOP_COMPLETE="complete_bash", **typed)


FOLDERS = ("calibrate", "collect", "drivers", "model", "sessions", "twin")
OF_ANOTHER_PROJECT = """
import model
from brushloop.model import ccdbsm
from drivers import ours

def test_the_two_names_are_two_packages(brushloop_rig):
    assert (model.OURS, ours.OURS) == ("model", "drivers")
    assert brushloop_rig.is_file() and ccdbsm.__name__ == "brushloop.model.ccdbsm"
"""


def another_project(folder: Path) -> Path:
    """A project with folders of our names, and a test that uses both."""
    for name in FOLDERS:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(f"OURS = {name!r}\n")
        (folder / name / "ours.py").write_text(f"OURS = {name!r}\n")
    (folder / "test_both.py").write_text(OF_ANOTHER_PROJECT)
    return folder


def test_a_project_with_folders_of_our_names_works_beside_an_editable_installation(
    command: Path, tmp_path: Path
) -> None:
    project = another_project(tmp_path)
    assert "1 passed" in run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", project, cwd=project)
    assert run(sys.executable, "-m", "brushloop", "--version", cwd=project) == "brushloop 0.1.0\n"


@pytest.mark.soak  # builds, installs, and takes as long as `make demo`
@pytest.mark.timeout(1800)
def test_the_demo_runs_from_the_wheel_in_a_project_with_folders_of_our_names(brushloop: Path, tmp_path: Path) -> None:
    project, python = another_project(tmp_path), brushloop.with_name("python")
    assert "1 passed" in run(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", project, cwd=project)
    assert run(brushloop, "--version", cwd=project) == "brushloop 0.1.0\n"
    run(brushloop, "demo", cwd=project)
    [report] = project.rglob("validation/report.html")
    assert "loopback rig" in report.read_text(encoding="utf-8")


OF_A_TWIN = """
import tomllib

def test_the_twin_presses(brushloop_twin):
    assert tomllib.loads(brushloop_twin.read_text())["brush"]["name"] == "our brush, simulated"
"""


@pytest.mark.soak  # builds and installs
def test_a_labs_own_tests_get_a_rig_and_its_twin(brushloop: Path, tmp_path: Path) -> None:
    blocks = blocks_of(ROOT / "docs" / "loopback-brush.md")
    documented = {block.kind: block.text for block in blocks if "tests/test_release.py" in block.remark}
    (tmp_path / "twin.toml").write_text('name = "our brush, simulated"\n[brush]\nfriction = 0.3\n')
    (tmp_path / "pytest.ini").write_text(documented["ini"])
    (tmp_path / "test_ours.py").write_text(documented["python"] + OF_A_TWIN)
    path = f"{brushloop.parent}:{os.environ['PATH']}"
    said = run(brushloop.with_name("python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=tmp_path, PATH=path)
    assert "2 passed" in said


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def locked(name: str) -> dict[str, str]:
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    lines = [Requirement(line) for line in text.splitlines() if line and not line.startswith("#")]
    return {canonicalize_name(line.name): next(iter(line.specifier)).version for line in lines}


def torch() -> dict[str, str]:
    return dict(re.findall(r'"(torch)==([\d.]+)"', (ROOT / "requirements" / "install.py").read_text(encoding="utf-8")))


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


@pytest.mark.parametrize("extra", ["", *PROJECT["optional-dependencies"]])
def test_what_is_locked_is_what_the_project_asks_for(extra: str) -> None:
    every = {**locked("run.lock"), **locked("dev.lock"), **torch()}
    asked = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    for requirement in map(Requirement, asked):
        assert requirement.specifier.contains(every[canonicalize_name(requirement.name)]), requirement
