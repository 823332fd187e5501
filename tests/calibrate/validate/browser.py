"""A page in headless Chromium: whether it fits its window, and what its console says."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

from tests.waiting import PATIENCE_S

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FRAME = '<iframe width="{width}" height="900" srcdoc="{page}"></iframe>'
SCRIPT = """<script>onload = () => document.body.insertAdjacentHTML("afterbegin", "<pre>" + JSON.stringify(
[...document.querySelectorAll("iframe")].map(f => [f.width, f.contentDocument.documentElement.scrollWidth])) + "</pre>")
</script>"""


def content_widths_px(page: str, widths_px: tuple[int, ...], folder: Path) -> tuple[dict[int, int], list[str]]:
    """The width that the page takes in windows of these widths, and the errors in the browser's console."""
    assert BROWSER is not None
    frames = "".join(FRAME.format(width=width, page=html.escape(page, quote=True)) for width in widths_px)
    outer = folder / "frames.html"
    outer.write_text(f"<!doctype html><meta charset=utf-8><body>{SCRIPT}{frames}", encoding="utf-8")
    flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom")
    profile = f"--user-data-dir={folder / 'profile'}"
    ran = subprocess.run(
        [BROWSER, *flags, profile, outer.as_uri()], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    found = re.search(r"<pre>(.*?)</pre>", ran.stdout)
    assert found is not None, ran.stderr[-2000:]
    sizes = {int(width): int(taken) for width, taken in json.loads(html.unescape(found[1]))}
    return sizes, [line for line in ran.stderr.splitlines() if ":CONSOLE" in line]
