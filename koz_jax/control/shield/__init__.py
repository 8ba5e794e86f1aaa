"""The shield: keeps every instrument out of its cones, whatever a controller asks for."""
