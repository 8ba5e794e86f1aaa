"""Trained agents for other programs: C99, ONNX, StableHLO.  ``python -m koz_jax.export AGENT --to c --out DIR``."""
