"""What the C source holds of observation, urgency and torque, by placeholder of the templates.

A policy of one spacecraft sees the paper's observation and commands shares of the torque limits.  One for any
spacecraft is exported for one of them: its units, axes and features are constants, and the urgency is a setting.
"""

import numpy as np

from koz_jax.export import c_text
from koz_jax.export.golden import Golden
from koz_jax.export.metadata import Metadata, Scaling

_OF_ONE = {
    "URGENCY_DEFINITION": "",
    "MEMORY_FIELD": "",
    "MEMORY_START": "",
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
    "OBSERVE_SPACECRAFT": "",
    "TORQUE": """    int i;
    koz_decide(observation, torque_B);
    for (i = 0; i < KOZ_ACTION_SIZE; i++)
        torque_B[i] = fabsf(torque_B[i]) <= 1.0f ? torque_B[i] * @LIMIT_OF_I@ : 0.0f;
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
""",
    "MEMORY_START": ", (float)(KOZ_URGENCY)",
    "SPACECRAFT": """static const float policy_axes[3][3] = {@AXES@}; /* rows in body components */
static const float rate_to_policy[3][3] = {@RATE_TO_POLICY@}; /* [s] the same times T */
static const float constant_parts[@SEEN_COUNT@] = {@SEEN@}; /* @SEEN_NAMES@ */
static const float torque_per_action[3][3] = {@TORQUE_PER_ACTION@}; /* [N m] */

static void multiply(const float m[3][3], const float v[3], float product[3])
{
    int i;
    for (i = 0; i < 3; i++) product[i] = koz_dot(m[i], v);
}

static void to_policy_axes(float v[3])
{
    const float v_B[3] = {v[0], v[1], v[2]};
    multiply(policy_axes, v_B, v);
}

static float usable(float urgency)
{
    if (urgency >= 0.0f && urgency <= 1.0f) return urgency;
    return urgency < 0.0f ? 0.0f : urgency > 1.0f ? 1.0f : (float)(KOZ_URGENCY);
}

""",
    "OBSERVE_BODY": """    remember(memory, &unit);
    observation[0] = memory->q_e[0];
    multiply(policy_axes, memory->q_e + 1, observation + 1);
    multiply(rate_to_policy, unit.omega_BN_B, observation + 4);
""",
    "ZONE_PLACE": "7 + 5 * place",
    "ZONE_DIRECTION": """        zone_direction(&unit, nearest, part + 2);
        to_policy_axes(part + 2);
""",
    "WHICH_ABSENT": "",
    "OBSERVE_SPACECRAFT": """    for (i = 0; i < @SEEN_COUNT@; i++)
        observation[7 + 5 * KOZ_OBSERVED_ZONES + i] = constant_parts[i];
    observation[KOZ_OBSERVATION_SIZE - 1] = 2.0f * usable(memory->urgency) - 1.0f;
""",
    "TORQUE": """    float action[KOZ_ACTION_SIZE];
    int i;
    koz_decide(observation, action);
    multiply(torque_per_action, action, torque_B);
    for (i = 0; i < KOZ_ACTION_SIZE; i++) {
        const float limit = @LIMIT_OF_I@;
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


def replacements(metadata: Metadata, vectors: Golden) -> dict[str, str]:
    """Text by placeholder; that of the first ones holds others, which come after them."""
    if metadata.scaling is None:
        return _OF_ONE | {"MEMORIES": ",\n".join(f"    {{{c_text.braced(q_e)}}}" for q_e in vectors.memory)}
    memories = (f"    {{{c_text.braced(each[:4])}, {c_text.number(each[4])}}}" for each in vectors.memory)
    return _OF_ANY | {
        "MEMORIES": ",\n".join(memories),
        "TORQUE_ROWS": c_text.rows(vectors.torque),
        **_constants(metadata.scaling),
    }


def _constants(scaling: Scaling) -> dict[str, str]:
    seen = [value for values in scaling.seen.values() for value in values]
    return {
        "URGENCY": c_text.number(scaling.urgency),
        "AXES": c_text.matrix(scaling.axes),
        "RATE_TO_POLICY": c_text.matrix(scaling.time_unit * np.array(scaling.axes)),
        "SEEN_COUNT": str(len(seen)),
        "SEEN_NAMES": ", ".join(scaling.seen),
        "SEEN": c_text.row(seen),
        "TORQUE_PER_ACTION": c_text.matrix(scaling.torque_per_action),
    }
