"""What the C source holds of observation, urgency and torque, by placeholder of the templates.

A policy of one spacecraft sees the paper's observation and commands shares of the torque limits.  One for any
spacecraft is exported for one of them: its units, axes and features are constants, and the urgency is a setting.  Where
that has several instruments, there is a set of them for each.
"""

from collections.abc import Callable, Sequence

import numpy as np

from koz_jax.export.c_source import literals
from koz_jax.export.golden import Golden
from koz_jax.export.metadata import Metadata, Scaling
from koz_jax.task.observation_layout import FREE_RATE, LEAST_RATE, LONGEST_TIME, slices

_OF_ONE = {
    "URGENCY_DEFINITION": "",
    "MEMORY_FIELD": "@LIMITS_FIELD@",
    "MEMORY_START": "@NO_LIMITS@",
    "SPACECRAFT": "",
    "OBSERVE_BODY": """    observation[15] = memory->q_e[0];
    remember(memory, &unit);
    for (i = 0; i < 4; i++) observation[i] = memory->q_e[i];
    for (i = 0; i < 3; i++) {
        observation[4 + i] = unit.omega_BN_B[i];
        observation[7 + i] = koz_boresight_B[i];
    }
""",
    "ZONE_PLACE": "(place == 0 ? 10 : 11 + 5 * place)",
    "ZONE_DIRECTION": "        zone_direction(&unit, nearest, part + 2);\n",
    "WHICH_ABSENT": "place > 0 && ",
    "ABSENT_BORESIGHT": "",
    "OBSERVE_SPACECRAFT": "@WHEELS@    koz_wheels_limits(&unit, memory->torque_limit);\n",
    "TORQUE": """    int i;
    koz_decide(observation, torque_B);
    for (i = 0; i < KOZ_ACTION_SIZE; i++)
        torque_B[i] = fabsf(torque_B[i]) <= 1.0f ? torque_B[i] * @LEFT_OF_I@ : 0.0f;
""",
    "MEMORY_CHECK": "        for (i = 0; i < 4; i++) observed = worse(observed, memory.q_e[i], observations[n][i]);\n",
    "EXPECTED_TORQUE": "@LIMIT_OF_I@ * actions[n][i]",
    "TORQUES": "",
}

_OF_ANY = {
    "URGENCY_DEFINITION": """
/* Urgency that koz_start sets, from 0 (thrifty) to 1 (as fast as the torque allows); yours to define. */
#ifndef KOZ_URGENCY
#define KOZ_URGENCY @URGENCY@
#endif

""",
    "MEMORY_FIELD": """    float urgency; /* from 0 to 1, yours to set at any time after koz_start */
@LIMITS_FIELD@@SEVERAL@    int instrument; /* that of the nearest zone, whose axes are the policy's */
""",
    "MEMORY_START": ", (float)(KOZ_URGENCY)@NO_LIMITS@@NO_INSTRUMENT@",
    "SPACECRAFT": """static const float policy_axes@OF_INSTRUMENTS@[3][3] = {@AXES@}; /* rows in body components */
static const float rate_to_policy@OF_INSTRUMENTS@[3][3] = {@RATE_TO_POLICY@}; /* [s] the same times T */
static const float constant_parts@OF_INSTRUMENTS@[@SEEN_COUNT@] = {@SEEN@}; /* @SEEN_NAMES@ */
static const float times_per_rate[3][3] = {@TIMES_PER_RATE@}; /* [s T] inertia over torque limits */
static const float torque_per_action@OF_INSTRUMENTS@[3][3] = {@TORQUE_PER_ACTION@}; /* [N m] */

static void multiply(const float m[3][3], const float v[3], float product[3])
{
    int i;
    for (i = 0; i < 3; i++) product[i] = koz_dot(m[i], v);
}

/* Time [T] for which the torque limits push, until the momentum of a rate [rad/s] is there or gone. */
static float time_of_torque(const float change_B[3])
{
    float time_B[3], longest = 0.0f;
    int i;
    multiply(times_per_rate, change_B, time_B);
    for (i = 0; i < 3; i++)
        if (fabsf(time_B[i]) > longest) longest = fabsf(time_B[i]);
    return longest;
}

static float usable(float urgency)
{
    if (urgency >= 0.0f && urgency <= 1.0f) return urgency;
    return urgency < 0.0f ? 0.0f : urgency > 1.0f ? 1.0f : (float)(KOZ_URGENCY);
}

@WHEELS@/* How the policy sees a largest rate [rad/s]. */
@WHEELS@static float seen_rate(float largest)
@WHEELS@{
@WHEELS@    const float share = largest / @FREE_RATE@;
@WHEELS@    return logf(share > 1.0f ? 1.0f : share < @LEAST_RATE@ ? @LEAST_RATE@ : share);
@WHEELS@}
@WHEELS@
""",
    "OBSERVE_BODY": """    float direction_B[3], twice_B[3];
    float *times = observation + KOZ_OBSERVATION_SIZE - 4;
@WHEELS@    const float share = koz_wheels_share(&unit);
    remember(memory, &unit);
""",
    # The boresight stands before the margin, and only of zones after the first.
    "ZONE_PLACE": "7 + 8 * place",
    "ZONE_DIRECTION": """@SEVERAL@        if (place == 0) memory->instrument = unit.zone_instrument[nearest];
        zone_direction(&unit, nearest, direction_B);
        multiply(policy_axes@OF_MEMORY@, direction_B, part + 2);
@FURTHER_ZONE@""",
    "WHICH_ABSENT": "",
    "OBSERVE_SPACECRAFT": """    observation[0] = memory->q_e[0];
    multiply(policy_axes@OF_MEMORY@, memory->q_e + 1, observation + 1);
    multiply(rate_to_policy@OF_MEMORY@, unit.omega_BN_B, observation + 4);
    for (i = 0; i < @SEEN_COUNT@; i++) observation[4 + 8 * KOZ_OBSERVED_ZONES + i] = constant_parts@OF_MEMORY@[i];
    for (i = 0; i < 3; i++) twice_B[i] = 2.0f * memory->q_e[1 + i] / @TIME_UNIT@;
    times[0] = time_of_torque(unit.omega_BN_B);
    times[2] = time_of_torque(twice_B);
@WHEELS@    koz_wheels_limits(&unit, memory->torque_limit);
@WHEELS@    times[0] /= share;
@WHEELS@    times[2] /= share;
@WHEELS@    for (i = 0; i < 3; i++) observation[@REACH@ + i] *= share;
@WHEELS@    observation[@RATE_LIMIT@] = seen_rate(koz_wheels_largest_rate(&unit));
    if (times[0] > @LONGEST@) times[0] = @LONGEST@;
    times[1] = 0.5f * times[0] * times[0];
    if (times[2] > @LONGEST_HALF_SQUARE@) times[2] = @LONGEST_HALF_SQUARE@;
    observation[KOZ_OBSERVATION_SIZE - 1] = 2.0f * usable(memory->urgency) - 1.0f;
""",
    "TORQUE": """    float action[KOZ_ACTION_SIZE];
    int i;
    koz_decide(observation, action);
    multiply(torque_per_action@OF_GIVEN_MEMORY@, action, torque_B);
    for (i = 0; i < KOZ_ACTION_SIZE; i++) {
        const float limit = @LEFT_OF_I@;
        torque_B[i] = torque_B[i] > limit ? limit : torque_B[i] < -limit ? -limit : torque_B[i];
        if (!(fabsf(torque_B[i]) <= limit)) torque_B[i] = 0.0f;
    }
""",
    "MEMORY_CHECK": "        observed = worse(observed, memory.q_e[0], observations[n][0]);\n",
    "EXPECTED_TORQUE": "torques[n][i]",
    "TORQUES": """
static const float torques[COUNT][KOZ_ACTION_SIZE] = {
@TORQUE_ROWS@
};
""",
}

# Of any policy for a spacecraft with wheels.
_ON_WHEELS = {name: _OF_ANY[name] for name in ("EXPECTED_TORQUE", "TORQUES")}

# Of a policy for any spacecraft that sees several zones.
_FURTHER = {
    "FURTHER_ZONE": """        if (place > 0)
            multiply(policy_axes@OF_MEMORY@, koz_boresight_B@OF_NEAREST@, part - 3);
""",
    "ABSENT_BORESIGHT": """            if (place > 0) part[-3] = part[-2] = part[-1] = 0.0f;
""",
}


def replacements(metadata: Metadata, vectors: Golden) -> dict[str, str]:
    """Text by placeholder; that of the first ones holds others, which come after them."""
    numbers = {"MEMORIES": ",\n".join(_memory(each, metadata) for each in vectors.memory)}
    numbers |= {"TORQUE_ROWS": literals.rows(vectors.torque)}
    if metadata.scaling is None:
        return _OF_ONE | (_ON_WHEELS if metadata.task.spacecraft.wheels else {}) | numbers
    scalings = [metadata.scaling, *(instrument.scaling for instrument in metadata.further_instruments)]
    further = _FURTHER if metadata.network.observed_zones > 1 else dict.fromkeys(_FURTHER, "")
    return _OF_ANY | further | numbers | _constants(scalings, metadata.network.observed_zones)


def _memory(row: np.ndarray, metadata: Metadata) -> str:
    """Initialiser of a memory of the self-test.  row: as of ``Golden``."""
    urgency = "" if metadata.scaling is None else f", {literals.number(row[4])}"
    return f"    {{{literals.braced(row[:4])}{urgency}@NO_LIMITS@@NO_INSTRUMENT@}}"


def _constants(scalings: Sequence[Scaling], zones: int) -> dict[str, str]:
    """Those of each instrument, and where what wheels change stands in the observation of so many zones."""
    own, where = scalings[0], slices(zones, scaled=True)

    def each(text: Callable[[Scaling], str]) -> str:
        return literals.of_each([text(scaling) for scaling in scalings])

    return {
        "URGENCY": literals.number(own.urgency),
        "AXES": each(lambda scaling: literals.matrix(scaling.axes)),
        "RATE_TO_POLICY": each(lambda scaling: literals.matrix(scaling.time_unit * np.array(scaling.axes))),
        "SEEN_COUNT": str(len(_seen(own))),
        "SEEN_NAMES": ", ".join(own.seen),
        "SEEN": each(lambda scaling: literals.row(_seen(scaling))),
        "REACH": str(where["reach"].start),
        "RATE_LIMIT": str(where["rate_limit"].start),
        "FREE_RATE": literals.number(FREE_RATE / own.time_unit),
        "LEAST_RATE": literals.number(LEAST_RATE),
        "TIMES_PER_RATE": literals.matrix(np.array(own.times_per_rate) / own.time_unit),
        "LONGEST": literals.number(LONGEST_TIME),
        "LONGEST_HALF_SQUARE": literals.number(LONGEST_TIME**2 / 2),
        "TIME_UNIT": literals.number(own.time_unit),
        "TORQUE_PER_ACTION": each(lambda scaling: literals.matrix(scaling.torque_per_action)),
    }


def _seen(scaling: Scaling) -> list[float]:
    return [value for values in scaling.seen.values() for value in values]
