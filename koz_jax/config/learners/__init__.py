"""Settings of learners beside Soft Actor-Critic, and of refinement, which polishes what they have learned."""
