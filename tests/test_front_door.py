"""The front door: light, one line per error, right exit codes."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from bench import pages
from brushloop.__main__ import EXIT_CODES
from tests.command import brushloop

ROOT = Path(__file__).parent.parent
HEAVY = ("torch", "cv2", "textual", "numpy", "pydantic", "mcap", "scipy", "brushloop.drivers.sim")


def loaded(program: str) -> list[str]:
    code = f"import sys\n{program}\nprint(*sorted(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ran.stdout.splitlines()[-1].split()


def test_help_loads_nothing_heavy() -> None:
    modules = loaded(
        "from brushloop.__main__ import app\nsys.argv = ['brushloop', '--help']\n"
        "try:\n    app()\nexcept SystemExit:\n    pass"
    )
    assert "brushloop" in modules
    for heavy in HEAVY:
        assert not [m for m in modules if m == heavy or m.startswith(heavy + ".")], heavy


def test_the_version_is_printed_and_the_module_runs_under_the_commands_name() -> None:
    ran = subprocess.run([sys.executable, "-m", "brushloop", "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["brushloop", version("brushloop")]


COMMANDS = (
    "collect --config no.toml --protocol no.toml --no-tui",
    "collect plan --config no.toml --protocol no.toml",
    "doctor --config no.toml",
    "calibrate nowhere",
    "fit nowhere",
    "validate nowhere",
    "validate diff nowhere nowhere",
    "invert nowhere",
    "loop nowhere --config no.toml",
    "loop compare nowhere nowhere",
    "write 字 --config no.toml",
    "sim --write-rig no/rig.toml",
    "sessions verify nowhere",
    "sessions export nowhere out",
    "sessions import nowhere --csv no.csv",
)
SLOW = ("torch", "scipy", "numba", "matplotlib", "skimage", "textual", "jinja2", "can", "rich.progress")
"""Packages that take from a tenth of a second to seconds to import, which no command needs to begin."""


def test_a_command_begins_to_work_before_anything_slow_is_imported(tmp_path: Path) -> None:
    program = f"""
import json, os
from brushloop.__main__ import main
os.chdir({str(tmp_path)!r})
found = {{}}
for command in {COMMANDS!r}:
    sys.argv = ["brushloop", *command.split()]
    before = set(sys.modules)
    try:
        main()
    except SystemExit as end:
        assert end.code == 2, (command, end.code)
    slow = sorted(name for name in {SLOW!r} if name in set(sys.modules) - before)
    if slow:
        found[command] = slow
sys.stderr.write(json.dumps(found))
"""
    ran = subprocess.run([sys.executable, "-c", f"import sys\n{program}"], capture_output=True, text=True, check=True)
    assert ran.stderr.splitlines()[-1] == "{}"


def test_a_rig_pc_collects_without_torch_and_a_validator_without_devices() -> None:
    assert "torch" not in loaded(
        "import brushloop.collect.engine.engine, brushloop.collect.headless, brushloop.collect.engine.open_or_resume\n"
        "import brushloop.collect.tui.app"
    )
    validating = loaded("import brushloop.calibrate.session, brushloop.calibrate.drags.report")
    assert not {"serial", "can", "textual", "brushloop.drivers"} & set(validating)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("validate", "nowhere"), "nowhere: no such session"),
        (("calibrate", "nowhere"), "nowhere: no such session"),
        (("collect", "--config", "no.toml", "--protocol", "no.toml", "--no-tui"), "no.toml: no such file"),
        (("sessions", "import", "nowhere", "--csv", "no.csv"), "nowhere: is not a folder"),
        (("sessions", "list", "nowhere"), "nowhere: is not a folder"),
        (("sim", "--write-rig", "no/rig.toml"), "brushloop: no/rig.toml: there is no folder no\n"),
        (("sim", "--rate", "nan"), "brushloop: --rate is 'nan', allowed: a number from 0.01 to 1000\n"),
        (("sim", "--rate", "fast"), "brushloop: --rate is 'fast', allowed: a number from 0.01 to 1000\n"),
        (
            (
                "sim",
                "--idle-exit=-1",
            ),
            "brushloop: --idle-exit is '-1', allowed: a number from 0\n",
        ),
        (
            ("write", "plan", "字", "--cell-mm", "1e300"),
            "brushloop: --cell-mm is '1e300', allowed: a number from 10 to 500\n",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    ran = brushloop(*arguments, cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert words in ran.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_process_ends_with_that_line_and_that_code() -> None:
    command = [sys.executable, "-m", "brushloop", "sessions", "list", "nowhere"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (2, brushloop("sessions", "list", "nowhere").stderr)


def test_the_page_about_exit_codes_is_that_of_the_code() -> None:
    assert pages.PAGE.read_text(encoding="utf-8") == pages.exit_codes(), "run `python -m bench.pages`"
    packages = ("calibrate", "collect", "drivers", "model", "sessions", "twin")
    source = "".join(path.read_text(encoding="utf-8") for name in packages for path in (ROOT / name).rglob("*.py"))
    raised = {int(code) for code in re.findall(r"^    exit_code(?:: ClassVar\[int\])? = (\d+)$", source, re.M)}
    assert {2, 4, 5, 6} <= raised <= EXIT_CODES.keys()
