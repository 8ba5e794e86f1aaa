"""What exported files say of reaction wheels, for those who make observations and torques themselves."""

from koz_jax.config.actuators.wheels import BRAKE_SHARE, LEAST_SHARE, Wheels

_LEFT = (
    "torque_limit is what they make at rest. With A their axes as rows, P the transpose of A's pseudo-inverse, h their"
    " momenta, H = A^T h, w the rate, the share of torque_limit that is left is the least over the wheels of"
    f" (max_torque - |P (w x H)|) / (|P| torque_limit), at least {LEAST_SHARE:g} and at most 1; what is left takes the"
    " place of torque_limit. For a torque on the body they also give what H takes, w x H in the middle of the step"
)
_SEEN = (
    "So reach and rate_limit in the observation are no constants, and given for the start, at rest. The same share is"
    " in reach, and stopping and turning are of what is left; rate_limit is of the largest rate that they can stop, or"
    " of max_rate_deg where that is less: the least over the wheels of (max_momentum - |h - P H|) / |row of P|, less L,"
    " over c, or 2 K / (L + sqrt(L^2 + 2 (c - a) K)) where that is less, with L = |I w + H|, a and c the extreme"
    f" moments of the inertia I, and K the smallest torque_limit times {1.0 - BRAKE_SHARE:g}"
)


def meaning_of(wheels: Wheels, scaled: bool) -> str:
    """What depends on the momentum of wheels; empty where there are none.  scaled: of a policy for any spacecraft."""
    if not wheels:
        return ""
    each = "; ".join(
        f"axis [{', '.join(f'{entry:.6g}' for entry in wheel.axis)}], {wheel.max_torque:g} N m,"
        f" {wheel.max_momentum:g} N m s"
        for wheel in wheels
    )
    return f"Reaction wheels: {each}. {_LEFT}.{f' {_SEEN}.' if scaled else ''}"
