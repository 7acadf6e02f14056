"""Camera files: our YAML, OpenCV, OpenPTV."""
