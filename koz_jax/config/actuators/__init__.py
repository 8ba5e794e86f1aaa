"""Settings of actuators that exchange momentum with the body."""
