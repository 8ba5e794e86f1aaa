"""Optional packages: what to say when one is missing."""

from koz_jax.errors import UserError


def missing(error: ModuleNotFoundError, extra: str) -> UserError:
    """Say what to install, when the import of an optional package failed.  extra: the one that brings the package."""
    package = (error.name or "").split(".")[0]
    return UserError(f"{package}: is not installed; install it with: pip install 'koz_jax[{extra}]'")
