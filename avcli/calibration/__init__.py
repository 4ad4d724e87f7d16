"""Camera calibration: boards and their corners, the fit of a lens and its uncertainty, and the camera's pose."""
