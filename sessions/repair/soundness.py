"""Whether one MCAP file is as it was recorded: read in full, and what is wrong told in words."""

from __future__ import annotations

from pathlib import Path

from google.protobuf.message import DecodeError
from pydantic import ValidationError

from sessions.errors import SessionDamaged
from sessions.recording.messages import decode_gray, decode_still
from sessions.recording.salvage import Scan, salvaged, scan
from sessions.recording.schemas import Stroke, Topic

IMAGES = (Topic.STILL, Topic.PREVIEW)


def file_problems(path: Path) -> tuple[Scan, list[str]]:
    """Read a file in full: its chunks and index, every image, and that every stroke has its still."""
    found = scan(path)
    problems = list(found.damage)
    if found.stated is not None and not problems and found.stated != dict(found.counts):
        problems.append(f"holds {dict(found.counts)}, but its index says {found.stated}")
    stills: set[int] = set()
    strokes: set[str] = set()
    try:
        for _schema, channel, message in salvaged(found):
            if channel.topic in IMAGES:
                decode_gray(decode_still(message.data), f"the image {message.sequence} on {channel.topic}")
            if channel.topic == Topic.STILL:
                stills.add(message.sequence)
            elif channel.topic == Topic.STROKE:
                stroke = Stroke.model_validate_json(message.data)
                if stroke.stroke_id in strokes:
                    problems.append(f"stroke {stroke.stroke_id} is there twice")
                strokes.add(stroke.stroke_id)
                if stroke.still not in stills:
                    problems.append(f"stroke {stroke.stroke_id} names still {stroke.still}, which is not there")
    except SessionDamaged as error:
        problems.append(f"{error.path} {error.what}")
    except (DecodeError, ValidationError) as error:
        problems.append(f"a message does not fit its schema ({type(error).__name__})")
    except OSError as error:
        problems.append(f"cannot be read: {error.strerror}")
    return found, problems
