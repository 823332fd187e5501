"""`python -m bench.report_picture REPORT.html`: the top of a report as docs/report.png, drawn by headless Chromium.

The picture in the README is of the report that `make demo` ends with.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

OUT = Path(__file__).resolve().parent.parent / "docs" / "report.png"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WINDOW_PX = (900, 1150)
MOST_S = 120.0


def find_browser() -> str | None:
    """Path of an installed Chromium; None without one."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def picture(report: Path, out: Path) -> None:
    """Draw the top of the page. Raises FileNotFoundError without a browser or page, subprocess errors if it fails."""
    browser = find_browser()
    if browser is None:
        raise FileNotFoundError(f"none of {', '.join(BROWSERS)} is installed")
    if not report.is_file():
        raise FileNotFoundError(f"{report}: no such file")
    with tempfile.TemporaryDirectory() as profile:
        size = ",".join(map(str, WINDOW_PX))
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={profile}"]
        drawn = [f"--window-size={size}", f"--screenshot={out.resolve()}", report.resolve().as_uri()]
        subprocess.run([browser, *options, *drawn], check=True, capture_output=True, timeout=MOST_S)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m bench.report_picture REPORT.html")
    try:
        picture(Path(sys.argv[1]), OUT)
    except FileNotFoundError as error:
        sys.exit(str(error))
    sys.stdout.write(f"{OUT}\n")
