"""A camera that distorts, collected with its lens file: the lens is recorded, captures judged, the rig checked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session
from brushloop.collect.engine.control import State
from brushloop.collect.errors import ConfigError, StepError
from brushloop.collect.rig.config import load_rig
from brushloop.collect.tui.review_screen import Review
from brushloop.sessions.journal import replay
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Topic
from tests.calibrate.given import kept_lens
from tests.journal_lines import read_lines
from tests.runs import wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab

K1 = -0.08


def lens_file(folder: Path, k1: float = K1) -> Path:
    return kept_lens(folder, (1024, 768), k1)


def named(lab: Lab, path: Path, also: str = "") -> Path:
    """Name the lens file in rig.toml, as an operator does."""
    rig = lab.folder / "rig.toml"
    text = rig.read_text().replace("[camera]", f'[camera]\nlens_file = "{path.relative_to(lab.folder)}"', 1)
    rig.write_text(text + also)
    return rig


def test_a_session_is_collected_straight_and_holds_its_lens(bent_lab: Lab) -> None:
    lens = lens_file(bent_lab.folder / "camera")
    named(bent_lab, lens, "\n[self_check]\nenabled = true\n")
    engine = bent_lab.engine()
    engine.start()
    wait_for_end(engine)
    assert engine.snapshot().state is State.DONE, engine.snapshot().messages

    [folder] = bent_lab.sessions.iterdir()
    [(schema, _, message)] = McapFile(Recording(folder).path).messages([str(Topic.CALIBRATION)])
    recorded = CameraCalibration.FromString(message.data)
    assert schema is not None
    assert (schema.name, recorded.width, recorded.height) == ("foxglove.CameraCalibration", 1024, 768)
    assert (list(recorded.D), recorded.K[0]) == ([K1, 0.0, 0.0, 0.0, 0.0], 1024.0)

    # The review looks through the recorded lens: the file that rig.toml names does not lie beside its snapshot.
    review = Review(folder)
    looked = review.pictures(next(capture for capture in review.captures if capture.counts))
    assert looked.binary is not None
    assert looked.binary.any()

    made = calibrate_session(CalibrateRequest(folder)).calibration
    assert made.lens is not None
    assert made.lens.source == f"lens file {lens.stem}"

    # The self-check spent three patches far apart, and the press lies on a fourth.
    lines = read_lines(folder / "journal.jsonl")
    [check] = [line for line in lines if line["event"] == "done" and line["result"]["kind"] == "self_check"]
    assert check["result"]["patches"] == [0, 5, 36]
    assert max(abs(scale - 1.0) for scale in check["result"]["scale"]) < 0.005
    state = replay(folder / "journal.jsonl")
    assert {(0, 0), (0, 5), (0, 36), (0, 1)} <= state.used_patches
    assert len(state.used_patches) == 4 + 3 * len(state.cut)


def test_without_the_lens_file_the_run_ends_before_ink_and_names_the_remedy(bent_lab: Lab) -> None:
    engine = bent_lab.engine()
    engine.start()
    with pytest.raises(StepError, match=r"the lens bends straight lines: .*camera\.lens_file"):
        wait_for_end(engine)
    [folder] = bent_lab.sessions.iterdir()
    assert replay(folder / "journal.jsonl").used_patches == set()


def test_what_is_no_lens_file_is_refused_in_one_line(bent_lab: Lab) -> None:
    lens = lens_file(bent_lab.folder)
    rig = named(bent_lab, lens)
    optics = load_rig(rig).camera.optics
    assert optics is not None
    assert optics.distortion[0] == K1
    lens.write_text(lens.read_text().replace("a board", "another"))
    with pytest.raises(ConfigError, match=r"rig.toml: camera.lens_file: .*was edited"):
        load_rig(rig)
    lens.unlink()
    with pytest.raises(ConfigError, match=r"rig.toml: camera.lens_file: .*no such file"):
        load_rig(rig)


def test_a_changed_lens_file_is_a_changed_configuration(bent_lab: Lab) -> None:
    rig = named(bent_lab, lens_file(bent_lab.folder))
    before = load_rig(rig).model_dump_json()
    other = lens_file(bent_lab.folder, -0.07)
    rig.write_text(rig.read_text().replace(lens_file(bent_lab.folder).name, other.name))
    assert load_rig(rig).model_dump_json() != before
