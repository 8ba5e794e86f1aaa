"""Settings of the learners beside Soft Actor-Critic."""
