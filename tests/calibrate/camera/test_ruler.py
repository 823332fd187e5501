"""A printed ruler shows whether a scan has the scale that the scanner says."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibrate.board.ruler import bars, check_scale
from calibrate.errors import CalibrationError
from sessions.imports.photographs import dpi_of

SCAN = Path(__file__).parents[4] / "shared" / "data" / "ardibid_scan_400dpi" / "01.jpg"


def test_a_bar_is_measured_to_a_fraction_of_a_pixel() -> None:
    fine = np.full((800, 4000), 240, np.uint8)
    fine[400:480, 402:3602] = 20
    fine[100:300, 100:400] = 20  # a stroke
    image = cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    [bar] = bars(image, 300)
    assert bar.length_px == pytest.approx(800.0, abs=0.3)
    assert bar.left_px == pytest.approx(100.5, abs=0.3)
    assert check_scale(image, 16.0, 50.0, "scan") == pytest.approx([0.0], abs=4e-4)
    with pytest.raises(CalibrationError, match="shows no bar of 70 mm"):
        check_scale(image, 16.0, 70.0, "scan")


@pytest.mark.skipif(not SCAN.is_file(), reason="the real scan with its printed rulers is not here")
def test_the_real_scans_scale_is_within_four_per_mille_of_its_upper_ruler() -> None:
    dpi = dpi_of(SCAN.read_bytes())
    assert dpi == (400.0, 400.0)
    upper, *_ = check_scale(cv2.imread(str(SCAN), 0), dpi[0] / 25.4, 50.8, "scan")
    assert abs(upper) <= 0.004
