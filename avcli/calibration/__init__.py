"""Camera calibration: boards and their corners, the KB-8 fit, its quality, and where the camera hangs."""
