"""Version of the package."""

from importlib import metadata


def version() -> str:
    """Version that is installed; ``0+uninstalled`` for a checkout that is only on the path."""
    try:
        return metadata.version("koz_jax")
    except metadata.PackageNotFoundError:
        return "0+uninstalled"
