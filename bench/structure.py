"""How large the product is, how its files hang together, and through how many of them one photograph goes.

`python -m bench structure` counts; nothing of it is timed. The way of a photograph is traced: one press is collected
from a loopback rig, calibrated and validated, and every product file is noted that has a function which was handed the
photograph or an image made from it. The peer is the goal; a ratio of 1 and more meets it.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bench.harness import BenchError, Result
from bench.processes import started

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("collect", "calibrate", "drivers", "sessions", "model", "twin")
LONG, SHORT = 300, 40
IMAGE_PX = 64 * 64
"""An array of two dimensions and as many values is taken for an image."""
PROTOCOL = 'kind = "grid"\ndepths_mm = [15.0]\ntilts_deg = [5.0]\nrepeats = 1\nseed = 0\n'


def run(*, n: int | None = None, seed: int = 0) -> list[Result]:
    """Counts of files, lines, files that are long or short, import circles, and the files of one capture."""
    del n
    files = [path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))]
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    modules = {path: length for path, length in lengths.items() if path.name != "__init__.py"}
    passed = capture_files(seed)
    counts = (
        ("files", len(files), 330),
        ("lines", sum(lengths.values()), 45_000),
        (f"files past {LONG} lines", sum(length > LONG for length in modules.values()), 0),
        (f"files under {SHORT} lines", sum(length < SHORT for length in modules.values()), 30),
        ("modules in import circles", len(circles(files)), 0),
        ("files that one capture passes", len(passed), 45),
    )
    return [
        Result(f"structure: {name}", value, "1", f"goal of {goal}", goal / value if value else 1.0, n=1, seed=seed)
        for name, value, goal in counts
    ]


def circles(files: list[Path]) -> list[str]:
    """Modules that import each other in a circle, also where an import waits until a function runs."""
    names = {module_of(path): number for number, path in enumerate(files)}
    edges = [(names[a], names[b]) for path in files for a, b in _imports(path, names) if a != b]
    if not edges:
        return []
    rows, columns = zip(*edges, strict=True)
    graph = coo_array((np.ones(len(edges)), (rows, columns)), shape=(len(names), len(names)))
    _, label = connected_components(graph, directed=True, connection="strong")
    crowded = np.flatnonzero(np.bincount(label) > 1)
    return sorted(name for name, number in names.items() if label[number] in crowded)


def module_of(path: Path) -> str:
    """The dotted name of a module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path, known: dict[str, int]) -> Iterator[tuple[str, str]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                if (target := full if full in known else node.module) in known:
                    yield module_of(path), target
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in known:
                    yield module_of(path), alias.name


def capture_files(seed: int) -> list[str]:
    """Product files, without the loopback rig's, of which a function is handed the photograph or what was made of it.

    Raises BenchError where a command fails.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig, protocol, sessions = folder / "rig.toml", folder / "protocol.toml", folder / "sessions"
        protocol.write_text(PROTOCOL, encoding="utf-8")
        with started("bench.loop_rig", str(rig), "0", "2", str(seed)):
            options = ["--config", str(rig), "--protocol", str(protocol), "--out", str(sessions), "--no-tui"]
            passed = _traced(folder / "collect.json", "collect", *options)
        session = str(next(sessions.iterdir()))
        passed |= _traced(folder / "calibrate.json", "calibrate", session)
        passed |= _traced(folder / "validate.json", "validate", session, "--workers", "1")
    return sorted(passed)


def _traced(out: Path, *command: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-m", "bench.structure", str(out), *command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode != 0:
        raise BenchError(f"brushloop {command[0]} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return set(json.loads(out.read_text(encoding="utf-8")))


class Tracer:
    """Notes product files whose functions are handed an image."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self._known: dict[str, str | None] = {}

    def __call__(self, frame: FrameType, event: str, _arg: object) -> None:
        """Look at one call (see `sys.setprofile`)."""
        if event != "call":
            return
        name = frame.f_code.co_filename
        if name not in self._known:
            self._known[name] = _product_file(name)
        product = self._known[name]
        if product is None or product in self.files:
            return
        count = frame.f_code.co_argcount + frame.f_code.co_kwonlyargcount
        if any(_holds_image(frame.f_locals.get(given)) for given in frame.f_code.co_varnames[:count]):
            self.files.add(product)


def _product_file(name: str) -> str | None:
    path = Path(name)
    if not path.is_relative_to(ROOT):
        return None
    parts = path.relative_to(ROOT).parts
    ours = parts[0] in PACKAGES and parts[:2] != ("drivers", "sim")
    return "/".join(parts) if ours else None


def _holds_image(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.ndim >= 2 and value.size >= IMAGE_PX
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return any(
            isinstance(inner := getattr(value, field.name, None), np.ndarray) and _holds_image(inner)
            for field in dataclasses.fields(value)
        )
    return False


def trace(out: Path, arguments: list[str]) -> None:
    """Run one brushloop command in this process and write down the product files that images went through."""
    import brushloop.__main__

    tracer = Tracer()
    sys.argv = ["brushloop", *arguments]
    threading.setprofile_all_threads(tracer) if sys.version_info >= (3, 12) else threading.setprofile(tracer)
    sys.setprofile(tracer)
    try:
        brushloop.__main__.main()
    finally:
        sys.setprofile(None)
        out.write_text(json.dumps(sorted(tracer.files)), encoding="utf-8")


if __name__ == "__main__":
    trace(Path(sys.argv[1]), sys.argv[2:])
