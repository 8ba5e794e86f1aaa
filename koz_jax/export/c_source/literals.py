"""Numbers, tables and situations as C99 source."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike


def number(value: float) -> str:
    """The shortest float32 constant that reads back as the same bits."""
    return f"{np.float32(value)!s}f"  # without !s it would have the digits of a float64


def row(values: Iterable[float]) -> str:
    """float32 constants between commas."""
    return ", ".join(number(value) for value in values)


def exact_row(values: Iterable[float]) -> str:
    """The same in double precision."""
    return ", ".join(repr(float(value)) for value in values)


def exact_matrix(table: Iterable[Iterable[float]]) -> str:
    """Initialisers of the rows of a small matrix in double precision, on one line."""
    return ", ".join(f"{{{exact_row(each)}}}" for each in table)


def braced(values: Iterable[float]) -> str:
    """An initialiser of an array."""
    return f"{{{row(values)}}}"


def rows(table: np.ndarray) -> str:
    """Initialisers of the rows (n, entries) of a table, one on a line."""
    return ",\n".join(f"    {braced(each)}" for each in table)


def matrix(table: ArrayLike) -> str:
    """Initialisers of the rows of a small matrix, on one line."""
    return ", ".join(braced(each) for each in np.asarray(table))


def of_each(texts: Sequence[str]) -> str:
    """Initialisers of what every instrument has: of one itself, of several one in braces for each."""
    return texts[0] if len(texts) == 1 else ", ".join(f"{{{text}}}" for text in texts)


def situations(table: np.ndarray, zones: int, wheels: int) -> str:
    """Initialisers of ``koz_situation``, one on a line.  table: (n, entries), rows as of ``situation``."""
    return ",\n".join(f"    {situation(each, zones, wheels)}" for each in table)


def situation(values: np.ndarray, zones: int, wheels: int) -> str:
    """Initialiser of a ``koz_situation``.

    values: (11 + 4 zones + wheels,), and the number of each zone's instrument where there are several.
    """
    parts = np.split(values, np.cumsum([4, 3, 4, 3 * zones, zones, wheels]))
    q_BN, omega, q_DN, axes, half_angles, momenta, numbers = parts
    attitude = ", ".join(braced(part) for part in (q_BN, omega, q_DN))
    axis_rows = ", ".join(braced(axis) for axis in axes.reshape(zones, 3))
    held = f", {braced(momenta)}" if wheels else ""
    which = f", {{{', '.join(str(int(number)) for number in numbers)}}}" if len(numbers) else ""
    return f"{{{attitude}, {{{axis_rows}}}, {braced(half_angles)}{held}{which}}}"
