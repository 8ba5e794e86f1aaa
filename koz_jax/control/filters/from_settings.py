"""The one place that makes a safety filter from settings."""

from koz_jax.config.filters import FilterConfig, ZohCbfConfig
from koz_jax.control.filters import zoh_cbf
from koz_jax.control.shield import filter as shield
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import ActionFilter, Model


def action_filter(config: FilterConfig, model: Model) -> ActionFilter:
    """Make the filter that settings ask for, for a spacecraft."""
    return zoh_cbf.from_config(config, model) if isinstance(config, ZohCbfConfig) else shield.from_config(config, model)


def under_filter(env: Reorientation, config: FilterConfig | None) -> Reorientation:
    """Put a filter between controllers and actuators of an environment; None leaves it as it is."""
    return env if config is None else env.replace(action_filter=action_filter(config, env.model))
