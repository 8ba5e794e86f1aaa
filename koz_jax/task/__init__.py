"""The task: pure functions of one sample, and the one environment."""
