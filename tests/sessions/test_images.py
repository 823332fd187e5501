"""Photographs of strangers: whole PNG and JPEG images are read, anything else is refused before it costs anything."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFile

from brushloop.sessions import messages
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray


def png_stating(width, height):
    """A small PNG that states any size."""
    size = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", size), (b"IDAT", zlib.compress(bytes(64))), (b"IEND", b"")]
    data = [struct.pack(">I", len(d)) + name + d + struct.pack(">I", zlib.crc32(name + d)) for name, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(data)


def jpeg(side=64, *options):
    noise = np.random.default_rng(1).integers(0, 255, (side, side), np.uint8)
    return cv2.imencode(".jpg", noise, options)[1].tobytes()


def jpeg_stating(width, height):
    data = bytearray(jpeg())
    frame_at = data.index(b"\xff\xc0")
    data[frame_at + 5 : frame_at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def progressive(scans):
    """A JPEG with its last scan repeated: ten bytes of file for another pass over every pixel."""
    gray = cv2.imencode(".jpg", np.full((64, 64), 200, np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last, have = gray[gray.rindex(b"\xff\xda") : -2], gray.count(b"\xff\xda")
    return gray[:-2] + last * (scans - have) + gray[-2:]


REFUSED = {
    "a PNG of 900 megapixels": (png_stating(30_000, 30_000), "900000000 pixels"),
    "a JPEG of 900 megapixels": (jpeg_stating(30_000, 30_000), "900000000 pixels"),
    "60,000 scans": (progressive(60_000), "JPEG image in more than 100 scans"),
    "nothing": (b"", "image"),
    "text": (b"hello", "image"),
    "bmp": (b"BM" + bytes(100), "image"),
    "no pixels": (png_stating(0, 8), "image"),
    "half jpeg": (jpeg()[:300], "image"),
    "filler": (b"\xff\xd8" + b"\xff" * 50, "image"),
}


@pytest.mark.parametrize(("data", "message"), REFUSED.values(), ids=REFUSED)
def test_a_bomb_and_what_is_no_whole_image_are_refused_in_one_line_before_anything_is_decoded(
    data, message, monkeypatch
):
    monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    with pytest.raises(SessionDamaged, match=message) as caught:
        decode_gray(data, "a still")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_too_large_is_refused(monkeypatch):
    decode_gray(jpeg(), "a still")
    monkeypatch.setattr(messages, "MAX_IMAGE_BYTES", 10)
    with pytest.raises(SessionDamaged, match="exceeds"):
        decode_gray(jpeg(), "a still")


def test_an_image_that_is_cut_or_has_a_wrong_bit_is_refused_by_us_and_not_by_a_library_on_stderr(make, capfd):
    whole = make.png()
    wrong = bytearray(whole)
    wrong[wrong.index(b"IDAT") + 9] ^= 1
    for data in [bytes(wrong), jpeg()[:-2], *(whole[:cut] for cut in range(len(whole) - 8))]:
        with pytest.raises(SessionDamaged):
            decode_gray(data, "a still")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("data", "gray"),
    [
        (progressive(12) + b"\xff\xd9 film ", 200),
        (cv2.imencode(".png", np.full((64, 64), 51_234, np.uint16))[1].tobytes(), 51_234 >> 8),
        (cv2.imencode(".png", np.full((64, 64, 4), (0, 0, 255, 9), np.uint8))[1].tobytes(), 76),
    ],
    ids=["a film behind a JPEG", "16 bits", "red, almost transparent"],
)
def test_an_image_is_read_as_gray(data, gray):
    np.testing.assert_array_equal(decode_gray(data, "a still"), np.full((64, 64), gray))


def test_a_photograph_is_seen_as_a_viewer_shows_it():
    """A person measured the dark corner in a viewer, which turns the picture as its orientation says."""
    image, exif, turned = np.full((60, 40), 230, np.uint8), Image.Exif(), io.BytesIO()
    image[:8, :8] = 20
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(image).save(turned, "JPEG", quality=100, exif=exif)
    gray = decode_gray(turned.getvalue(), "a still")
    assert (gray.shape, gray[5, 35] < 60) == ((40, 60), False)
    assert gray[5, 55] < 60
