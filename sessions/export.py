"""Export a recording for other tools: images with CSV tables, NumPy arrays, or Parquet.

Every export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. The images are the photographs as they were recorded, byte for byte, or crops and masks by a cropper, one at
a time; the tables are held in memory. `header.json` says where everything comes from.

`png`      images/, with a cropper masks/ and, if asked, frames/; strokes.csv, poses.csv, forces.csv
`npz`      strokes.npz, which loads without pickle: an array per column of the table of strokes, (n,), NaN where a value
           is missing; image_0000, ... (h, w) uint8 gray, also mask_0000 and frame_0000; pose_<column> (m,),
           pose_position_mm (m, 3), pose_quaternion (m, 4); with a force sensor force_<column> (k,), force_wrench (k, 6)
`parquet`  what Hugging Face `datasets` loads: a data set card, and the tables strokes/, poses/, forces/ with columns
           named as LeRobot names them; an image is a struct {bytes, path}. `timestamp` is the measured time in seconds
           since the first sample of the stroke; there is no fixed frame rate, which a LeRobotDataset would require.

`episode_index` joins the tables: a stroke is an episode.
"""

from __future__ import annotations

import html
import importlib
import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brushloop.sessions.cells import CsvWriter
from brushloop.sessions.disk import check_room, staged_folder, sync, write_durably
from brushloop.sessions.errors import InputError, disk_error
from brushloop.sessions.export_rows import (
    FORCE_COLUMNS,
    POSE_COLUMNS,
    SAMPLE_COLUMNS,
    Cropper,
    Export,
    Row,
    Sample,
    file_column,
)
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, plain, unseen

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

ROWS_PER_GROUP = 32
"""Photographs held in memory at a time; viewers want small groups for rows with images."""
SAMPLES_PER_GROUP = 20_000
FILE = "train-00000-of-00001.parquet"
LICENCE_ID = re.compile(r"[a-z0-9][a-z0-9.-]{0,39}")
"""What a card may give as `license`; any other text is given as `license_name`."""


def export(
    source: Path,
    out: Path,
    kind: str,
    progress: Progress = unseen,
    make_cropper: Callable[[Recording], Cropper] | None = None,
    *,
    frames: bool = False,
) -> list[tuple[str, str]]:
    """Export a session into the new or empty folder `out` as `png`, `npz` or `parquet`.

    With `make_cropper`, every photograph is replaced by a crop and its mask; `frames` keeps the whole photograph as
    well. Returns (stroke, reason) of the strokes that could not be cropped. Raises `InputError` for an unknown format,
    a folder that is not empty, or a session of which no stroke can be cropped, `SessionDamaged` for a recording that
    cannot be read; nothing is left behind then.
    """
    writers = {"png": write_png, "npz": write_npz, "parquet": write_parquet}
    if (write := writers.get(kind)) is None:
        raise InputError("--format", f"{kind!r}, allowed: {', '.join(writers)}")
    recording = Recording(source)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever overwritten")
    if recording.strokes() == 0:
        raise InputError(recording.path, "holds no strokes to export")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        exported = Export(recording, progress, None if make_cropper is None else make_cropper(recording), frames)
        with staged_folder(out) as stage:
            write(exported, stage)
            write_durably(stage / "header.json", exported.header_json())
            if len(exported.left_out) == len(exported.strokes):
                stroke_id, reason = exported.left_out[0]
                raise InputError(recording.path, f"holds no stroke that can be cropped: {stroke_id} {reason}")
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    return exported.left_out


def write_png(export: Export, folder: Path) -> None:
    """Write pictures and tables."""
    for name in export.pictures:
        (folder / f"{name}s").mkdir()
    rows: list[Row] = []
    for row, pictures in export.captures():
        for name, data in pictures.items():
            write_durably(folder / str(row[file_column(name)]), data)
        rows.append(row)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    _write_csv(folder / "strokes.csv", columns, ([row.get(name) for name in columns] for row in rows))
    tables = [("poses", POSE_COLUMNS, export.poses())]
    tables += [("forces", FORCE_COLUMNS, export.forces())] if export.has_force else []
    for name, values, samples in tables:
        _write_csv(
            folder / f"{name}.csv", (*SAMPLE_COLUMNS, *values), ((*when, *measured) for when, measured in samples)
        )


def _write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        table = CsvWriter(file, "\r\n")
        table.writerow(columns)
        table.writerows(rows)
        sync(file)


def write_npz(export: Export, folder: Path) -> None:
    """Write `strokes.npz`."""
    import numpy as np

    with (folder / "strokes.npz").open("xb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:

            def add(name: str, values: ArrayLike) -> None:
                # Members carry no time, so that equal arrays make equal files.
                member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                member.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(member, "w", force_zip64=True) as out:
                    np.lib.format.write_array(out, np.asarray(values), allow_pickle=False)

            rows: list[Row] = []
            for number, (row, pictures) in enumerate(export.captures()):
                for name, data in pictures.items():
                    add(f"{name}_{number:04d}", decode_gray(data, f"stroke {row['stroke_id']}"))
                rows.append(row)
            for name in export.text_columns:
                add(name, np.array([row.get(name) or "" for row in rows], np.str_))
            for name in export.number_columns():
                values = (row.get(name) for row in rows)
                add(name, np.array([math.nan if value is None else value for value in values], np.float64))
            parts = {"pose_position_mm": slice(3), "pose_quaternion": slice(3, 7)}
            _add_samples(add, "pose", list(export.poses()), len(POSE_COLUMNS), parts)
            if export.has_force:
                parts = {"force_wrench": slice(6)}
                _add_samples(add, "force", list(export.forces()), len(FORCE_COLUMNS), parts)
        sync(file)


def _add_samples(
    add: Callable[[str, ArrayLike], None], stem: str, samples: list[Sample], width: int, parts: dict[str, slice]
) -> None:
    import numpy as np

    when = np.array([when for when, _values in samples], np.int64).reshape(-1, len(SAMPLE_COLUMNS))
    values = np.array([values for _when, values in samples], np.float64).reshape(-1, width)
    for name, column in zip(SAMPLE_COLUMNS, when.T, strict=True):
        add(f"{stem}_{name}", column)
    for name, part in parts.items():
        add(name, values[:, part])


def write_parquet(export: Export, folder: Path) -> None:
    """Write the tables and the card. Raises `InputError` where pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError("--format", "parquet needs pyarrow: pip install pyarrow") from None

    numbers = [name for name in export.number_columns() if name != "episode_index"]
    picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    strokes = [(name, picture) for name in export.pictures] + [("episode_index", pa.int64())]
    strokes += [(name, pa.string()) for name in export.text_columns] + [(name, pa.float64()) for name in numbers]
    sampled = [(name, pa.int64()) for name in ("episode_index", "frame_index", "index", "task_index")]
    sampled += [("timestamp", pa.float64()), *((name, pa.int64()) for name in ("t_ns", "log_ns", "sequence"))]
    pictured = (_with_pictures(*capture) for capture in export.captures())
    tables: list[tuple[str, Any, Iterator[Row], int]] = [("strokes", strokes, pictured, ROWS_PER_GROUP)]
    series = [("poses", "observation.state", POSE_COLUMNS, export.poses())]
    series += [("forces", "observation.force", FORCE_COLUMNS, export.forces())]
    for name, column, names, samples in series:
        fields = [*sampled, (column, pa.list_(pa.float64(), len(names)))]
        tables.append((name, fields, _sample_rows(samples, column), SAMPLES_PER_GROUP))
    counts: dict[str, int] = {}
    for name, fields, rows, group in tables:
        schema = pa.schema(fields)
        schema = schema.with_metadata({"huggingface": json.dumps({"info": {"features": _features(pa, schema)}})})
        some = list(islice(rows, group))
        if not some:
            continue  # `datasets` refuses a file without rows
        (folder / name).mkdir()
        with pq.ParquetWriter(folder / name / FILE, schema) as writer:
            while some:
                writer.write_table(pa.Table.from_pylist(some, schema=schema))
                counts[name] = counts.get(name, 0) + len(some)
                some = list(islice(rows, group))
    write_durably(folder / "README.md", _card(export, counts))


def _with_pictures(row: Row, pictures: dict[str, bytes]) -> Row:
    return row | {name: {"bytes": data, "path": row[file_column(name)]} for name, data in pictures.items()}


def _sample_rows(samples: Iterator[Sample], column: str) -> Iterator[Row]:
    start_ns = 0
    for index, (when, values) in enumerate(samples):
        row = dict(zip(SAMPLE_COLUMNS, when, strict=True))
        start_ns = row["t_ns"] if row["frame_index"] == 0 else start_ns
        seconds = (row["t_ns"] - start_ns) / 1e9
        yield {**row, "index": index, "task_index": 0, "timestamp": seconds, column: list(values)}


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
    given = {"Brush": header.brush, "Ink": header.ink, "Paper": header.paper, "Robot": header.robot}
    facts = " ".join(f"{name}: {_text(value)}." for name, value in {**given, "Licence": header.licence}.items())
    images = (
        "`image` is a crop seen straight from above, `px_per_mm_x` pixels per mm, gray and not corrected for the\n"
        "light; `mask` is 255 where the stroke's ink is. Ink of neighbouring strokes may show in `image`."
        if export.cropper
        else "`image` is the photograph as it was recorded."
    )
    text = f"""---
{_licence(header.licence)}configs:
{configs}---
# {_text(header.session_id)}

Source: **{header.source}**. {", ".join(f"{count} {name}" for name, count in counts.items())}, from \
{_text(export.recording.path.name)} (SHA-256 `{export.recording.sha256}`).

{facts}

`strokes`: one row per stroke; `depth_mm` is the commanded depth H, `reached_mm` the depth that the arm reached,
`tilt_deg` the tilt alpha. {images}

`poses`, where any were recorded: poses of the brush tip in the robot's base frame; `observation.state` is \
{", ".join(POSE_COLUMNS)}. `forces`, likewise: samples of the force sensor, in its own frame; `observation.force` is \
{", ".join(FORCE_COLUMNS)}.

`episode_index` joins the tables. `timestamp` is in seconds from the stroke's first sample, as measured;
`sequence` shows gaps.
"""
    if export.left_out:
        text += "\n## Strokes without a crop, left out\n"
        text += "".join(f"- {_text(stroke_id)}: {_text(reason)}\n" for stroke_id, reason in export.left_out)
    return text.encode()


def _licence(name: str) -> str:
    """The card's YAML about the licence; JSON strings are YAML."""
    if not name:
        return ""
    return f"license: {name}\n" if LICENCE_ID.fullmatch(name) else f"license: other\nlicense_name: {json.dumps(name)}\n"


def _text(text: str) -> str:
    """A text from a recording, in a card: neither HTML, Markdown nor a new line."""
    return re.sub(r"([\\`*_\[\]#|~])", r"\\\1", html.escape(plain(text))) or "not given"
