"""What is released works without the repository: the wheel, the source archive, and completion in shells."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import tarfile
import time
import venv
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parent.parent


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


@pytest.mark.soak  # builds, installs, and takes as long as `make demo`
@pytest.mark.timeout(1800)
def test_the_demo_runs_from_the_wheel_in_an_empty_folder(brushloop: Path, tmp_path: Path) -> None:
    assert run(brushloop, "--version", cwd=tmp_path) == "brushloop 0.1.0\n"
    run(brushloop, "demo", cwd=tmp_path)
    [report] = tmp_path.rglob("validation/report.html")
    assert "loopback rig" in report.read_text(encoding="utf-8")


COMPLETIONS = [
    ("bash", {"COMP_WORDS": "brushloop sess", "COMP_CWORD": "1"}, "sessions"),
    ("zsh", {"_TYPER_COMPLETE_ARGS": "brushloop sessions ex"}, "export"),
]


@pytest.fixture
def command() -> Path:
    """The command beside this Python."""
    path = Path(sys.executable).with_name("brushloop")
    if not path.is_file():
        pytest.skip("brushloop is not installed beside this Python")
    return path


@pytest.mark.parametrize(("shell", "typed", "completed"), COMPLETIONS, ids=["bash", "zsh"])
def test_a_shell_is_given_what_completes_a_command(
    command: Path, tmp_path: Path, shell: str, typed: dict[str, str], completed: str
) -> None:
    assert completed in run(command, cwd=tmp_path, _BRUSHLOOP_COMPLETE=f"complete_{shell}", **typed)


LOAD = 'eval "$(brushloop --show-completion)"'
SHELLS = [
    ("bash", ["--norc", "--noprofile", "-i"], LOAD),
    ("zsh", ["-f", "-i"], f"autoload -U compinit; compinit -u; {LOAD}"),
]


@pytest.mark.soak  # an interactive shell that starts brushloop twice
@pytest.mark.parametrize(("shell", "options", "load"), SHELLS, ids=["bash", "zsh"])
def test_tab_completes_a_command_in_a_shell(
    command: Path, tmp_path: Path, shell: str, options: list[str], load: str
) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    here, there = pty.openpty()
    path = f"{command.parent}:{os.environ['PATH']}"
    environment = {"PATH": path, "HOME": str(tmp_path), "TERM": "dumb", "LANG": "C.UTF-8", "PS1": "> "}
    started = {"stdin": there, "stdout": there, "stderr": there, "start_new_session": True}
    with subprocess.Popen([shell, *options], env=environment, cwd=tmp_path, **started) as process:
        os.close(there)
        try:
            os.write(here, f'{load}; echo rea""dy\n'.encode())
            read_until(here, b"ready\r\n")
            os.write(here, b"brushloop ses\t")
            read_until(here, b"brushloop sessions ")
        finally:
            process.kill()
            os.close(here)


def read_until(terminal: int, words: bytes) -> None:
    """Read what a terminal shows until it shows these words; fails after `PATIENCE_S`."""
    shown, deadline = b"", time.monotonic() + PATIENCE_S
    while words not in shown:
        assert time.monotonic() < deadline, shown
        if select.select([terminal], [], [], 1.0)[0]:
            shown += os.read(terminal, 4096)


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
    assert "collect" in run(command, "--help", cwd=project)


@pytest.mark.soak  # builds, installs, and takes as long as `make demo`
@pytest.mark.timeout(1800)
def test_a_project_with_folders_of_our_names_works_beside_the_wheel(brushloop: Path, tmp_path: Path) -> None:
    project, python = another_project(tmp_path), brushloop.with_name("python")
    assert "1 passed" in run(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", project, cwd=project)
    assert run(brushloop, "demo", "--repeats", "1", "--out", tmp_path / "demo", cwd=project)


DOCUMENTED = re.compile(r"<!-- tested by tests/test_release\.py -->\n```(\w+)\n(.*?)```", re.DOTALL)
OF_A_TWIN = """
import tomllib

def test_the_twin_presses(brushloop_twin):
    assert tomllib.loads(brushloop_twin.read_text())["brush"]["name"] == "our brush, simulated"
"""


@pytest.mark.soak  # builds and installs
def test_a_labs_own_tests_get_a_rig_and_its_twin(brushloop: Path, tmp_path: Path) -> None:
    documented = dict(DOCUMENTED.findall((ROOT / "docs" / "loopback-brush.md").read_text()))
    (tmp_path / "twin.toml").write_text('name = "our brush, simulated"\n[brush]\nfriction = 0.3\n')
    (tmp_path / "pytest.ini").write_text(documented["ini"])
    (tmp_path / "test_ours.py").write_text(documented["python"] + OF_A_TWIN)
    path = f"{brushloop.parent}:{os.environ['PATH']}"
    said = run(brushloop.with_name("python"), "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=tmp_path, PATH=path)
    assert "2 passed" in said
