"""Kill -9 at random points, again and again: every stroke exactly once, no cell twice, nothing lost."""

from __future__ import annotations

import random
import subprocess
from typing import TYPE_CHECKING

import pytest

from sessions.journal import read_lines, replay
from sessions.reader import Recording

if TYPE_CHECKING:
    from conftest import Lab

STROKES = 6


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_a_session_that_is_killed_again_and_again_ends_whole(lab: Lab, seed: int) -> None:
    lab.write_protocol(heights="[11.0, 13.0, 15.0]")
    rng = random.Random(seed)
    kills = 0
    while True:
        process = lab.process()
        try:
            # Starting takes about 2 s; a session that is let run takes about 8.
            _, stderr = process.communicate(timeout=rng.uniform(2.0, 6.0) if kills < 8 else 120.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
            if any(replay(path).closed for path in lab.sessions.glob("*/journal.jsonl")):
                break  # killed on its way out, with all done
            continue
        assert process.returncode == 0, stderr
        break

    [folder] = lab.sessions.iterdir()
    strokes = [capture.stroke.stroke_id for capture in Recording(folder).captures()]
    assert len(strokes) == len(set(strokes)) == STROKES, f"after {kills} kills"
    begun = [line for line in read_lines(folder / "journal.jsonl") if line["event"] == "begin"]
    cells = [(line["sheet"], line["cell"]) for line in begun if line["cell"] is not None]
    assert len(cells) == len(set(cells))
    for line in replay(folder / "journal.jsonl").segments:
        assert (folder / line["file"]).is_file(), "what was finished is kept beside the merged file"
