"""Parquet files that Hugging Face `datasets` loads: strokes with images, and poses as a time series.

    README.md                                  data set card: two configurations, `strokes` and `poses`
    strokes/train-00000-of-00001.parquet       one row a stroke; `image` is a struct {bytes, path}, feature `Image`
    poses/train-00000-of-00001.parquet         one row a pose, columns named as LeRobot names them
    header.json

`episode_index` joins the two: a stroke is an episode. `timestamp` is the measured time in seconds
since the first pose of the stroke; there is no fixed frame rate, which a complete LeRobotDataset would require.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sessions.disk import write_durably
from sessions.errors import InputError
from sessions.export.rows import TEXT_COLUMNS, Export, PoseRow, Row

ROWS_PER_GROUP = 32
"""Photographs held in memory at a time; viewers want small groups for rows with images."""
POSES_PER_GROUP = 20_000
FILE = "train-00000-of-00001.parquet"
STATE_NAMES = ["x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]


def write_parquet(export: Export, folder: Path) -> None:
    """Write the files listed in this module's docstring. Raises `InputError` where pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError("--format", "parquet needs pyarrow: pip install pyarrow") from None

    numbers = _number_columns(export)
    strokes = pa.schema(
        [
            pa.field("image", pa.struct([("bytes", pa.binary()), ("path", pa.string())])),
            pa.field("episode_index", pa.int64()),
            *(pa.field(name, pa.string()) for name in TEXT_COLUMNS),
            *(pa.field(name, pa.float64()) for name in numbers),
        ]
    )
    poses = pa.schema(
        [
            pa.field("episode_index", pa.int64()),
            pa.field("frame_index", pa.int64()),
            pa.field("index", pa.int64()),
            pa.field("task_index", pa.int64()),
            pa.field("timestamp", pa.float64()),
            pa.field("t_ns", pa.int64()),
            pa.field("log_ns", pa.int64()),
            pa.field("sequence", pa.int64()),
            pa.field("observation.state", pa.list_(pa.float64(), len(STATE_NAMES))),
        ]
    )
    counts: dict[str, int] = {}
    for name, schema, groups in (
        ("strokes", strokes, _stroke_groups(export, numbers)),
        ("poses", poses, _pose_groups(export)),
    ):
        (folder / name).mkdir()
        counts[name] = 0
        described = schema.with_metadata({"huggingface": json.dumps({"info": {"features": _features(pa, schema)}})})
        with pq.ParquetWriter(folder / name / FILE, described) as writer:
            for rows in groups:
                writer.write_table(pa.Table.from_pylist(rows, schema=described))
                counts[name] += len(rows)
    write_durably(folder / "README.md", _card(export, counts))
    write_durably(folder / "header.json", export.header_json())


def _number_columns(export: Export) -> list[str]:
    """Names of the numeric columns that any stroke has: the file has one schema."""
    names: dict[str, None] = {}
    for stroke in export.recording.stroke_records():
        names |= dict.fromkeys(f"commanded_{name}" for name in stroke.commanded)
    row, _capture = next(export.captures())
    first = [name for name in row if name not in (*TEXT_COLUMNS, "episode_index")]
    return list(dict.fromkeys([*first, *names]))


def _stroke_groups(export: Export, numbers: list[str]) -> Iterator[list[Row]]:
    group: list[Row] = []
    for row, capture in export.captures():
        known = {name: row.get(name) for name in ("episode_index", *TEXT_COLUMNS, *numbers)}
        group.append({"image": {"bytes": capture.still_png, "path": row["file"]}, **known})
        if len(group) == ROWS_PER_GROUP:
            yield group
            group = []
    if group:
        yield group


def _pose_groups(export: Export) -> Iterator[list[Row]]:
    group: list[Row] = []
    start_ns = 0
    for index, pose in enumerate(export.poses()):
        start_ns = pose.t_ns if pose.frame_index == 0 else start_ns
        group.append(_pose_row(pose, index, start_ns))
        if len(group) == POSES_PER_GROUP:
            yield group
            group = []
    yield group


def _pose_row(pose: PoseRow, index: int, start_ns: int) -> Row:
    return {
        "episode_index": pose.episode_index,
        "frame_index": pose.frame_index,
        "index": index,
        "task_index": 0,
        "timestamp": (pose.t_ns - start_ns) / 1e9,
        "t_ns": pose.t_ns,
        "log_ns": pose.log_ns,
        "sequence": pose.sequence,
        "observation.state": [*pose.position_mm, *pose.quaternion],
    }


def _features(pa: Any, schema: Any) -> Row:
    """Description of the schema as `datasets` stores it in the file's metadata."""
    features: Row = {}
    for field in schema:
        if field.name == "image":
            features[field.name] = {"_type": "Image"}
        elif pa.types.is_fixed_size_list(field.type):
            value = {"dtype": str(field.type.value_type).replace("double", "float64"), "_type": "Value"}
            features[field.name] = {"feature": value, "length": field.type.list_size, "_type": "Sequence"}
        else:
            features[field.name] = {"dtype": str(field.type).replace("double", "float64"), "_type": "Value"}
    return features


def _card(export: Export, counts: dict[str, int]) -> bytes:
    header = export.recording.header
    configs = "".join(
        f"- config_name: {name}\n  default: {str(name == 'strokes').lower()}\n  data_files:\n"
        f"  - split: train\n    path: {name}/train-*.parquet\n"
        for name in counts
    )
    licence = f"license: {json.dumps(header.licence)}\n" if header.licence else ""
    return (
        f"---\n{licence}configs:\n{configs}---\n"
        f"# {header.session_id}\n\n"
        f"Source: **{header.source}**. {counts['strokes']} strokes, {counts['poses']} poses, from "
        f"`{export.recording.path.name}` (SHA-256 `{export.recording.sha256}`).\n\n"
        f"`strokes`: one row a stroke, `image` as it was recorded. `poses`: one row a pose of the brush tip in the\n"
        f"robot's base frame; `observation.state` is {', '.join(STATE_NAMES)}. `episode_index` joins the two.\n"
        f"`timestamp` is in seconds from the first pose of the stroke, as measured; `sequence` shows gaps.\n"
    ).encode()
