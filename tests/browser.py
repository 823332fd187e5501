"""Pages in headless Chromium: whether they fit their windows, and what the console says."""

from __future__ import annotations

import html
import json
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path

from bench.pictures import find_browser
from tests.waiting import PATIENCE_S

BROWSER = find_browser()
FRAME = '<iframe name="{name}" width="{width}" height="900" srcdoc="{page}"></iframe>'
SCRIPT = """<script>onload = () => document.body.insertAdjacentHTML("afterbegin", "<pre>" + JSON.stringify(
[...document.querySelectorAll("iframe")].map(f => [f.name, f.width, f.contentDocument.documentElement.scrollWidth])) +
"</pre>")
</script>"""


def content_widths_px(
    pages: Mapping[str, str], widths_px: tuple[int, ...], folder: Path
) -> tuple[dict[tuple[str, int], int], list[str]]:
    """The width that each named page takes in windows of these widths, and the errors in the browser's console."""
    assert BROWSER is not None
    frames = "".join(
        FRAME.format(name=name, width=width, page=html.escape(page, quote=True))
        for name, page in pages.items()
        for width in widths_px
    )
    outer = folder / "frames.html"
    outer.write_text(f"<!doctype html><meta charset=utf-8><body>{SCRIPT}{frames}", encoding="utf-8")
    flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom")
    profile = f"--user-data-dir={folder / 'profile'}"
    ran = subprocess.run(
        [BROWSER, *flags, profile, outer.as_uri()], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    found = re.search(r"<pre>(.*?)</pre>", ran.stdout)
    assert found is not None, ran.stderr[-2000:]
    sizes = {(name, int(width)): int(taken) for name, width, taken in json.loads(html.unescape(found[1]))}
    return sizes, [line for line in ran.stderr.splitlines() if ":CONSOLE" in line]
