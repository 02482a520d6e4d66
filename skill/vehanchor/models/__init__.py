"""Model files, ONNX sessions, and the bundled models."""
