"""Every topic that a rig may record: its schema is one that viewers know, and the merged file carries it."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from mcap.reader import make_reader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.decoder import DecoderFactory

from brushloop.collect.engine.recorder import Recorder
from brushloop.drivers.devices import PoseSample, Stamp
from brushloop.drivers.geometry import Pose
from brushloop.drivers.host import Clock
from brushloop.sessions.events import PressResult
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import image_message
from brushloop.sessions.records import Check, Event, InkState, Quality, Topic, Wrench


@pytest.fixture
def each(make):
    """One message on every topic."""
    t_ns = make.t0_ns
    jpeg = cv2.imencode(".jpg", np.full((32, 32), 200, np.uint8))[1].tobytes()
    messages = {
        Topic.CALIBRATION: CameraCalibration(frame_id="camera"),
        Topic.PREVIEW: image_message(t_ns, jpeg, "jpeg"),
        Topic.WRENCH: Wrench(fx_n=0.0, fy_n=0.1, fz_n=-1.5, mx_nm=0.0, my_nm=0.0, mz_nm=0.01),
        Topic.INK: InkState(level=0.7, dosed_ml=1.25, light=0.5),
        Topic.QUALITY: Quality(
            stroke_id="H13-a05-r00",
            checks=(Check(name="sharp", score=0.2, threshold=0.4, passed=False, reason="out of focus"),),
        ),
    }
    outgoing = [Outgoing(topic, t_ns, t_ns, n, message) for n, (topic, message) in enumerate(messages.items())]
    recorder = Recorder(SimpleNamespace(write=outgoing.append), Clock())
    recorder.paper((400.0, -100.0, 5.0), (0.0, 0.0, 0.0, 1.0))
    recorder.log("brush is dry")
    pose = Pose(1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    recorder.pose(PoseSample(Stamp(t_ns, None, 0), pose, joints_rad=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0)))
    return [*outgoing, make.still(0), make.stroke(0)]


@pytest.fixture
def merged(make, store, each):
    """Schema and channel of each topic of the merged file."""
    make.take(store, "all", each, PressResult(press=make.press()))
    with store.close().open("rb") as file:
        return {channel.topic: (schema, channel) for schema, channel, _ in make_reader(file).iter_messages()}


def test_the_merged_file_carries_every_topic_under_a_name_that_viewers_know(merged):
    assert set(merged) == {str(topic) for topic in Topic}
    for schema, channel in merged.values():
        if schema.name.startswith("foxglove."):
            assert (schema.encoding, channel.message_encoding) == (SchemaEncoding.Protobuf, MessageEncoding.Protobuf)
        else:
            assert schema.name.startswith("brushloop.")
            assert (schema.encoding, channel.message_encoding) == (SchemaEncoding.JSONSchema, MessageEncoding.JSON)
            assert json.loads(schema.data)["type"] == "object"
    names = {topic: schema.name for topic, (schema, _) in merged.items()}
    assert names["/robot/joints"] == "foxglove.JointStates"
    assert names["/tf"] == "foxglove.FrameTransforms"
    assert names["/camera/calibration"] == "foxglove.CameraCalibration"
    assert names["/force/wrench"] == "brushloop.Wrench"


def test_any_viewer_decodes_them_from_the_schemas_in_the_file(make, tmp_path, each):
    path = make.record(tmp_path / "a.mcap", *each)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        protobuf = [message.topic for message in each if not isinstance(message.message, Event)]
        decoded = {c.topic: m for _, c, _, m in reader.iter_decoded_messages(topics=protobuf)}
    assert set(decoded) == set(map(str, protobuf))
    joints = decoded["/robot/joints"].joints
    assert [(joint.name, joint.position) for joint in joints][2] == ("joint3", 2.0)
    assert not joints[0].HasField("velocity")
    [transform] = decoded["/tf"].transforms
    assert (transform.parent_frame_id, transform.translation.x, transform.rotation.w) == ("base", 0.4, 1.0)
    assert (decoded["/camera/preview"].format, decoded["/camera/still"].format) == ("jpeg", "png")
    assert decoded["/camera/still"].data == make.png(0)
    assert (decoded["/log"].message, decoded["/log"].level) == ("brush is dry", 2)


LAYOUT = Path(__file__).parents[2] / "docs" / "foxglove-layout.json"


def test_the_foxglove_layout_asks_for_topics_and_fields_that_there_are(merged):
    panels = json.dumps(json.loads(LAYOUT.read_text())["configById"])
    asked = re.findall(r'"(/[a-z/]+)((?:\.\w+)*)"', panels)
    assert {topic for topic, _ in asked} <= set(merged)
    for topic, path in asked:
        for field in filter(None, path.split(".")[1:2] + path.split(".")[-1:]):
            assert field.encode() in merged[topic][0].data, f"{topic}{path}"
