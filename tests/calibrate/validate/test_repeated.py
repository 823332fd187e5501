"""A press that repeats a stroke of another given session stands against that stroke: the third row of Table 1."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.pool import threads
from brushloop.calibrate.validate import jobs
from brushloop.calibrate.validate.jobs import PrepareJob, Press, prepare_job
from brushloop.calibrate.validate.run import ANOTHER, REPEATED, Options, validate_presses
from brushloop.calibrate.validate.sources import open_session
from brushloop.sessions.recording import Recording


def test_the_repetition_is_scored_against_its_original_only(
    session: Path, make_session: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = make_session(tmp_path, "again", repeats=1, blank=False, seed=90)  # pyright: ignore[reportCallIssue]

    def repeating(job: PrepareJob) -> Press:
        """As a replay protocol records it: each stroke of the second session repeats one of the first."""
        if "again" in job.capture.where:
            stroke = job.capture.stroke.model_copy(
                update={"again_of": job.capture.stroke.stroke_id, "stroke_id": f"again-{job.capture.stroke.stroke_id}"}
            )
            job = PrepareJob(type(job.capture)(stroke, job.capture.still_png, job.capture.where), None, job.view)
        return prepare_job(job)

    monkeypatch.setattr(jobs, "prepare_job", repeating)
    sessions = [open_session(str(place), tmp_path, None, None) for place in (session, again)]
    with threads(1) as pool:
        outcome = validate_presses(sessions, Options(held_out=False), pool, tmp_path, lambda *_: None)
    with outcome.store:
        found = outcome.scores.of(REPEATED)[:, :, 0]
        repeats = [row.session == 1 for row in outcome.rows]
        assert np.array_equal(np.isfinite(found).all(axis=1), repeats)
        assert sum(repeats) == 5
        # Two presses of one command by one brush: about as alike as the originals among themselves.
        another = outcome.scores.of(ANOTHER)[:10, :, 0]
        assert np.nanmean(found) == pytest.approx(np.nanmean(another), abs=0.05)


def test_a_capture_keeps_its_place(session: Path) -> None:
    capture = next(Recording(session).captures())
    assert prepare_job(PrepareJob(capture, None, Field())).stroke_id == "000"
