"""Single-gimbal control moment gyros: what their gimbals do."""
