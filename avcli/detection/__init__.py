"""People from a ceiling camera: in depth pictures or by an ONNX network, and from there to places in the room."""
