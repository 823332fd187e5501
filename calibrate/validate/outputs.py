"""Every score on disk, as CSV and as Parquet, written as it is read: neither is ever whole in memory."""

from __future__ import annotations

import csv
import hashlib
import importlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.errors import CalibrationError
from calibrate.field import KEYS
from calibrate.validate.run import Outcome

COLUMNS = ("session_id", "stroke_id", "height_mm", "tilt_deg", "model", "alignment", "tone", "csim", "ssim", "source")
GROUP = 2000
"""Strokes of one row group of the Parquet file."""
Cells = tuple[str, str, float, float, str, str, str, float, float, str]


def score_rows(outcome: Outcome) -> Iterator[Cells]:
    """One row a score, by session and order of capture; scores that are not there are left out."""
    for k, row in enumerate(outcome.rows):
        header = outcome.sessions[row.session].header
        press = row.press
        for m, model in enumerate(outcome.names):
            for j, (alignment, tone) in enumerate(KEYS):
                csim, ssim = (float(v) for v in outcome.values[k, m, j])
                if np.isfinite(csim):
                    yield (
                        header.session_id,
                        press.stroke_id,
                        press.height_mm,
                        press.tilt_deg,
                        model,
                        str(alignment),
                        str(tone),
                        csim,
                        ssim,
                        str(header.source),
                    )


def write_csv(outcome: Outcome, path: Path) -> str:
    """Write every score and return the file's SHA-256. Raises OSError; what was half written is then gone."""
    part = path.with_name(path.name + ".part")
    digest = hashlib.sha256()
    try:
        with part.open("wb") as file:
            for text in _lines(outcome):
                data = text.encode()
                digest.update(data)
                file.write(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return digest.hexdigest()


def _lines(outcome: Outcome) -> Iterator[str]:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in score_rows(outcome):
        writer.writerow([f"{v:.8f}" if k in (7, 8) else v for k, v in enumerate(row)])
        if out.tell() > 2**16:
            yield out.getvalue()
            out.seek(0)
            out.truncate()
    yield out.getvalue()


def write_parquet(outcome: Outcome, path: Path) -> None:
    """The same rows. Raises `CalibrationError` where pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise CalibrationError("--parquet", "needs pyarrow: pip install 'brushloop[parquet]'") from None
    kinds = [pa.float64() if name in ("height_mm", "tilt_deg", "csim", "ssim") else pa.string() for name in COLUMNS]
    schema: Any = pa.schema(
        list(zip(COLUMNS, kinds, strict=True)), metadata={"source": str(outcome.sessions[0].header.source)}
    )
    part = path.with_name(path.name + ".part")
    try:
        with pq.ParquetWriter(part, schema) as writer:
            for group in _groups(outcome):
                columns = [list(column) for column in zip(*group, strict=True)]
                writer.write_table(pa.table(columns, schema=schema))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _groups(outcome: Outcome) -> Iterator[list[Cells]]:
    group: list[Cells] = []
    most = GROUP * len(outcome.names)
    for row in score_rows(outcome):
        group.append(row)
        if len(group) == most:
            yield group
            group = []
    if group:
        yield group
