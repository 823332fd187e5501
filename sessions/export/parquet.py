"""Parquet files that Hugging Face `datasets` loads: strokes with images, and poses as a time series.

    README.md                                  data set card: a configuration for each table
    strokes/train-00000-of-00001.parquet       one row per stroke; `image` is a struct {bytes, path}, feature `Image`
    poses/train-00000-of-00001.parquet         one row a pose, columns named as LeRobot names them; if there are any
    forces/train-00000-of-00001.parquet        one row a sample of the force sensor; if there are any
    header.json

With a cropper, a stroke also has `mask`, and `frame` if asked. `episode_index` joins the tables: a stroke is an
episode. `timestamp` is the measured time in seconds since the first sample of the stroke; there is no fixed frame rate,
which a complete LeRobotDataset would require.
"""

from __future__ import annotations

import html
import importlib
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from brushloop.sessions.disk import write_durably
from brushloop.sessions.errors import InputError
from brushloop.sessions.export.rows import Export, ForceRow, PoseRow, Row
from brushloop.sessions.terminal import plain

ROWS_PER_GROUP = 32
"""Photographs held in memory at a time; viewers want small groups for rows with images."""
SAMPLES_PER_GROUP = 20_000
FILE = "train-00000-of-00001.parquet"
STATE_NAMES = ["x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]
FORCE_NAMES = ["fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm"]
LICENCE_ID = re.compile(r"[a-z0-9][a-z0-9.-]{0,39}")
"""What a card may give as `license`; any other text is given as `license_name`."""


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
            *(pa.field(name, pa.struct([("bytes", pa.binary()), ("path", pa.string())])) for name in export.pictures),
            pa.field("episode_index", pa.int64()),
            *(pa.field(name, pa.string()) for name in export.text_columns),
            *(pa.field(name, pa.float64()) for name in numbers),
        ]
    )
    sampled = [
        *(pa.field(name, pa.int64()) for name in ("episode_index", "frame_index", "index", "task_index")),
        pa.field("timestamp", pa.float64()),
        *(pa.field(name, pa.int64()) for name in ("t_ns", "log_ns", "sequence")),
    ]
    poses = pa.schema([*sampled, pa.field("observation.state", pa.list_(pa.float64(), len(STATE_NAMES)))])
    forces = pa.schema([*sampled, pa.field("observation.force", pa.list_(pa.float64(), len(FORCE_NAMES)))])
    tables = [("strokes", strokes, _stroke_groups(export, numbers)), ("poses", poses, _sample_groups(export.poses()))]
    if export.has_force:
        tables.append(("forces", forces, _sample_groups(export.forces())))
    counts: dict[str, int] = {}
    for name, schema, groups in tables:
        (folder / name).mkdir()
        counts[name] = 0
        described = schema.with_metadata({"huggingface": json.dumps({"info": {"features": _features(pa, schema)}})})
        with pq.ParquetWriter(folder / name / FILE, described) as writer:
            for rows in groups:
                writer.write_table(pa.Table.from_pylist(rows, schema=described))
                counts[name] += len(rows)
        if not counts[name]:  # `datasets` refuses a file without rows
            del counts[name]
            (folder / name / FILE).unlink()
            (folder / name).rmdir()
    write_durably(folder / "README.md", _card(export, counts))
    write_durably(folder / "header.json", export.header_json())


def _number_columns(export: Export) -> list[str]:
    """Names of the numeric columns that any stroke has: the file has one schema."""
    rows = (export.row(0, stroke) for stroke in export.recording.stroke_records())
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if name not in (*export.text_columns, "episode_index")]


def _stroke_groups(export: Export, numbers: list[str]) -> Iterator[list[Row]]:
    group: list[Row] = []
    for row, pictures in export.captures():
        paths = {name: row["file" if name == "image" else f"{name}_file"] for name in pictures}
        images = {name: {"bytes": data, "path": paths[name]} for name, data in pictures.items()}
        group.append(images | {name: row.get(name) for name in ("episode_index", *export.text_columns, *numbers)})
        if len(group) == ROWS_PER_GROUP:
            yield group
            group = []
    if group:
        yield group


def _sample_groups(samples: Iterable[PoseRow | ForceRow]) -> Iterator[list[Row]]:
    group: list[Row] = []
    start_ns = 0
    for index, sample in enumerate(samples):
        start_ns = sample.t_ns if sample.frame_index == 0 else start_ns
        group.append(_sample_row(sample, index, start_ns))
        if len(group) == SAMPLES_PER_GROUP:
            yield group
            group = []
    yield group


def _sample_row(sample: PoseRow | ForceRow, index: int, start_ns: int) -> Row:
    if isinstance(sample, PoseRow):
        measured: Row = {"observation.state": [*sample.position_mm, *sample.quaternion]}
    else:
        measured = {"observation.force": list(sample.wrench)}
    return {
        "episode_index": sample.episode_index,
        "frame_index": sample.frame_index,
        "index": index,
        "task_index": 0,
        "timestamp": (sample.t_ns - start_ns) / 1e9,
        "t_ns": sample.t_ns,
        "log_ns": sample.log_ns,
        "sequence": sample.sequence,
        **measured,
    }


def _features(pa: Any, schema: Any) -> Row:
    """Description of the schema as `datasets` stores it in the file's metadata."""
    features: Row = {}
    for field in schema:
        if field.name in ("image", "mask", "frame"):
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
    numbers = ", ".join(f"{count} {name}" for name, count in counts.items())
    lines = [
        f"---\n{_licence(header.licence)}configs:\n{configs}---",
        f"# {_text(header.session_id)}\n",
        f"Source: **{header.source}**. {numbers}, from {_text(export.recording.path.name)} "
        f"(SHA-256 `{export.recording.sha256}`).\n",
        f"Brush: {_text(header.brush)}. Ink: {_text(header.ink)}. Paper: {_text(header.paper)}. "
        f"Robot: {_text(header.robot)}. Licence: {_text(header.licence)}.\n",
        "`strokes`: one row per stroke; `depth_mm` is the commanded depth H, `tilt_deg` the tilt alpha. "
        + (
            "`image` is a crop seen straight from above, `px_per_mm_x` pixels per mm, gray and not corrected for the\n"
            "light; `mask` is 255 where the stroke's ink is. Ink of neighbouring strokes may show in `image`.\n"
            if export.cropper
            else "`image` is the photograph as it was recorded.\n"
        ),
        f"`poses`: one row per pose of the brush tip in the robot's base frame; `observation.state` is "
        f"{', '.join(STATE_NAMES)}."
        if "poses" in counts
        else "No poses were recorded.",
        f"`forces`: one row per sample of the force sensor, in its own frame; `observation.force` is "
        f"{', '.join(FORCE_NAMES)}."
        if "forces" in counts
        else "No forces were recorded.",
        "\n`episode_index` joins the tables. `timestamp` is in seconds from the stroke's first sample, as measured;\n"
        "`sequence` shows gaps.",
    ]
    if export.left_out:
        lines.append("\n## Strokes without a crop, left out")
        lines += [f"- {_text(stroke_id)}: {_text(reason)}" for stroke_id, reason in export.left_out]
    return ("\n".join(lines) + "\n").encode()


def _licence(name: str) -> str:
    """The card's YAML about the licence; JSON strings are YAML."""
    if not name:
        return ""
    return f"license: {name}\n" if LICENCE_ID.fullmatch(name) else f"license: other\nlicense_name: {json.dumps(name)}\n"


def _text(text: str) -> str:
    """A text from a recording, in a card: neither HTML, Markdown nor a new line."""
    return re.sub(r"([\\`*_\[\]#|~])", r"\\\1", html.escape(plain(text))) or "not given"
