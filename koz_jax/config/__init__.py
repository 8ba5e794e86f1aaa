"""Settings in degrees, validated once; imports no jax."""
