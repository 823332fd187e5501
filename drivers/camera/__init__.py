"""Cameras behind OpenCV: a device, a stream, or a video file."""

from brushloop.drivers.camera.opencv import OpenCvCamera
from brushloop.drivers.camera.source import CameraTable, Locked, found_settings

__all__ = ["CameraTable", "Locked", "OpenCvCamera", "found_settings"]
