"""Numbers for people: with the decimals that ordinary sizes have, and with enough digits for every other size."""

import math

# Beyond these powers of ten there would be more zeros than digits.
_SMALLEST, _LARGEST = -5, 7


def significant(value: float, decimals: int, digits: int = 3) -> str:
    """Print a number with some decimals, or with more of them where it would show less than ``digits`` digits.

    Very small and very large numbers are printed with a power of ten; zero and what is not finite with the decimals.
    """
    if value == 0.0 or not math.isfinite(value):
        return f"{value:.{decimals}f}"
    power = math.floor(math.log10(abs(value)))
    if not _SMALLEST <= power < _LARGEST:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(decimals, digits - 1 - power)}f}"


def percent(rate: float) -> str:
    """Print a share in [0, 1] with two decimals, or with more where it would seem to be zero."""
    return f"{significant(100.0 * rate, 2, 1)} %"


def percent_between(rate: float, low: float, high: float) -> str:
    """Print a share in [0, 1] with its interval, all with the decimals that the smallest of them needs to be seen.

    At 0 of n the lower bound is zero, and rounding may leave something of it: it does not count.
    """
    shown = [significant(100.0 * share, 2, 1) for share in (rate, high)]
    decimals = max((len(text.partition(".")[2]) for text in shown if "e" not in text), default=2)
    return f"{100 * rate:.{decimals}f} %  [{100 * low:.{decimals}f}, {100 * high:.{decimals}f}]"
