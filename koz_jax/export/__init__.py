"""Trained agents for other programs: C99, ONNX, StableHLO.  ``koz export AGENT --to c --out DIR``."""
