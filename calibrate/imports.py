"""`brushloop sessions import`: photographs from elsewhere, or the scan of a printed sheet, become a session."""

from __future__ import annotations

import time
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.board.sheet import find_sheet, holds_ink
from brushloop.calibrate.board.spec import MM_PER_INCH
from brushloop.calibrate.commands import ImportRequest
from brushloop.calibrate.files import Written, read_gray
from brushloop.calibrate.stroke.preprocess import PX_PER_MM
from brushloop.sessions.imports import ImportOptions, import_photographs, read_table
from brushloop.sessions.messages import encode_png
from brushloop.sessions.terminal import Progress, unseen

TAKEN_AS_EXACT = "The print was taken to be exact: measure it and give --measured-mm to be sure of every length."


def import_session(request: ImportRequest, progress: Progress = unseen) -> Written:
    """Import a folder of photographs, or the boxes of a scanned sheet, into a new session.

    Raises `InputError` and `CalibrationError`, leaving nothing behind. Boxes that do not agree with the table are
    returned in `left_out`.
    """
    common = {field.name for field in fields(ImportOptions)} & {field.name for field in fields(request)}
    options = ImportOptions(**{name: getattr(request, name) for name in common})
    source, radius, length = request.photographs, request.brush_radius_mm, request.brush_length_mm
    out = request.out or Path("sessions") / (source.resolve().stem if source.is_file() else source.resolve().name)
    size = f"Brush: R = {radius:g} mm, L = {length:g} mm (--brush-radius-mm, --brush-length-mm)"
    said, left_out = [size] if request.kind == "press" else [], list[tuple[str, str]]()
    if not source.is_file():
        path = import_photographs(source, request.csv, out, options, made_by(), time.time_ns, progress=progress)
    else:
        scan = find_sheet(read_gray(source), str(source), request.measured_mm)
        with TemporaryDirectory() as temporary:
            boxes = Path(temporary).resolve() / source.name
            boxes.mkdir()
            pictures = {name: scan.picture(box, PX_PER_MM) for name, box in scan.layout.boxes().items()}
            for name, picture in pictures.items():
                (boxes / f"{name}.png").write_bytes(encode_png(picture))
            inked = {name for name, picture in pictures.items() if holds_ink(picture, PX_PER_MM)}
            options = replace(options, px_per_mm=PX_PER_MM, start_px=scan.start_px(PX_PER_MM))
            named = {image.stem for image, _ in read_table(boxes, request.csv, options)}
            path = import_photographs(boxes, request.csv, out, options, made_by(), time.time_ns, progress=progress)
        left_out += [(box, "is blank, but the table has a row for it") for box in sorted(named - inked)]
        left_out += [(box, "holds ink, but the table has no row for it") for box in sorted(inked - named)]
        across, along = scan.px_per_mm
        dpi, marks = round(across * MM_PER_INCH), len(scan.layout.marks())
        seen = f"{marks - scan.missing} of {marks} marks are seen, within {scan.residual_mm:.2f} mm of a flat sheet"
        said.append(f"Scan: {dpi} dpi, one pixel is {1 / across:.5f} mm across and {1 / along:.5f} mm along; {seen}")
        said += [TAKEN_AS_EXACT] if request.measured_mm is None else []
        said += [f"Box {box} {why}" for box, why in left_out]
    return Written(path, [f"Imported into {path}", *said, f"Next: brushloop analyse {path.parent}"], left_out)
