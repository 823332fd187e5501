"""`python -m bench.exit_codes`: renew docs/exit-codes.md from the front door's table and the errors in the code."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

from brushloop.__main__ import EXIT_CODES

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "exit-codes.md"
PACKAGES = ("calibrate", "collect", "drivers", "model", "sessions", "twin")


def page() -> str:
    """The page about exit codes, as Markdown."""
    codes = [f"| {code} | {meaning} |" for code, meaning in EXIT_CODES.items()]
    errors = [f"| {code} | `{name}` | {text} |" for code, name, text in sorted(raised())]
    return "\n".join(
        [
            "# Exit codes\n",
            "Every command ends with one of these codes. An error is reported in one line that names the file, the "
            "field and the allowed range.",
            "This page is generated from the code by `python -m bench.exit_codes`.\n",
            "| code | meaning |",
            "|---|---|",
            *codes,
            "\n## Errors in Python",
            "Each error class has its code in `exit_code`; classes derived from these have the same one.\n",
            "| code | class | meaning |",
            "|---|---|---|",
            *errors,
            "",
        ]
    )


def raised() -> Iterator[tuple[int, str, str]]:
    """Code, full name and first line of the docstring of each class in the code that sets an exit code of its own."""
    for path in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "exit_code" not in source:
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef) and (code := _code(node)) is not None:
                module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                yield code, f"{module}.{node.name}", inspect.cleandoc(ast.get_docstring(node) or "").split("\n")[0]


def _code(node: ast.ClassDef) -> int | None:
    for line in node.body:
        targets = [line.target] if isinstance(line, ast.AnnAssign) else getattr(line, "targets", [])
        named = any(isinstance(target, ast.Name) and target.id == "exit_code" for target in targets)
        if named and isinstance(value := getattr(line, "value", None), ast.Constant):
            return int(str(value.value))
    return None


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
