"""The loopback rig's camera: scene, optics, MJPEG stream."""
