"""A policy on its own: exported as a directory, as ONNX, as numpy, and on the Hugging Face Hub."""
