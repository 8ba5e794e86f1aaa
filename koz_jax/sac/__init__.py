"""Soft Actor-Critic for any environment; knows nothing of spacecraft."""
