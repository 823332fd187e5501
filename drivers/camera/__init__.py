"""Cameras behind OpenCV: a device, a stream, a file, or a folder of images."""

from brushloop.drivers.camera.opencv import OpenCvCamera
from brushloop.drivers.camera.source import CameraTable, Locked, found_settings

__all__ = ["CameraTable", "Locked", "OpenCvCamera", "found_settings"]
