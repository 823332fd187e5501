"""Install the locked packages into the environment whose Python runs this file.

    python requirements/install.py run [--torch auto|cpu|cuda]
    python requirements/install.py dev [--torch auto|cpu|cuda]

`run` is what brushloop needs, `dev` adds what tests and checks need. Where there is no NVIDIA card, torch is installed
in its CPU build, which is a tenth of the size of the default build for Linux. PIP_FIND_LINKS and pip's configuration
are honoured. Only the standard library is used: nothing else is there yet.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
TORCH = "torch==2.13.0"
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""Where the maker of torch keeps its CPU builds; PyPI has only the CUDA build for Linux."""
ANSWER_S = 3.0
PIP = (sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile")


def torch_arguments(build: str) -> list[str]:
    """What to give pip for torch in this build: `auto`, `cpu` or `cuda`."""
    if build == "auto":
        build = "cuda" if has_nvidia_card() else "cpu"
    if build == "cuda" or platform.system() != "Linux" or wheel_at_hand():
        return [TORCH]
    if answers(CPU_INDEX):
        return ["--index-url", CPU_INDEX, "--no-deps", TORCH]
    sys.stderr.write(f"{CPU_INDEX} does not answer: installing the default build of torch, about 3 GB larger\n")
    return [TORCH]


def has_nvidia_card() -> bool:
    """Whether this machine has an NVIDIA card with its driver."""
    return Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None


def wheel_at_hand() -> bool:
    """Whether PIP_FIND_LINKS names a folder that holds a CPU build; pip prefers it to PyPI's build."""
    pattern = TORCH.replace("==", "-") + "+cpu-*.whl"
    return any(any(Path(place).glob(pattern)) for place in os.environ.get("PIP_FIND_LINKS", "").split())


def answers(url: str) -> bool:
    """Whether a server answers in `ANSWER_S`, whatever it says."""
    try:
        with urllib.request.urlopen(f"{url}/torch/", timeout=ANSWER_S):
            return True
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False


def main() -> None:
    """Install; ends with pip's exit code where pip fails."""
    parser = argparse.ArgumentParser(description="Install brushloop's locked packages.")
    parser.add_argument("what", choices=("run", "dev"))
    parser.add_argument("--torch", choices=("auto", "cpu", "cuda"), default="auto")
    options = parser.parse_args()
    steps = [["--no-deps", "-r", str(HERE / "run.lock")], torch_arguments(options.torch)]
    if options.what == "dev":
        steps.append(["--no-deps", "-r", str(HERE / "dev.lock")])
    steps.append(["--no-deps", "--no-build-isolation", "--editable", str(HERE.parent)])
    for step in steps:
        if code := subprocess.run([*PIP, *step], check=False).returncode:
            sys.exit(code)


if __name__ == "__main__":
    main()
