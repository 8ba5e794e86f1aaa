import pytest


@pytest.fixture(scope="module", autouse=True)
def _strict_shapes_everywhere(strict_shapes: None) -> None:
    """Code for one sample needs no implicit broadcasting between ranks."""
