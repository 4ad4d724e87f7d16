"""People from a ceiling camera: found in depth pictures or by an ONNX network, then placed in the room."""
