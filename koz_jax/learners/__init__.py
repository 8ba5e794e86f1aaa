"""Learners beside Soft Actor-Critic, on its networks and replay buffer; none knows of spacecraft."""
