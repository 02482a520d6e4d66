"""ONNX sessions, and the models that ship with the library."""
