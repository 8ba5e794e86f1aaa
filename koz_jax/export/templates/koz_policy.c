/*
@HEAD@
 */
#include "koz_policy.h"

#include <stddef.h>

#include "koz_math.h"
@WHEELS@#include "koz_wheels.h"

static const float pi = 3.14159265f;

@WEIGHTS@

static int is_direction(const float *v, int size)
{
    float squared = 0.0f;
    int i;
    for (i = 0; i < size; i++) squared += v[i] * v[i];
    return squared > 1e-12f && squared < 1e12f; /* false where something is not a number */
}

const char *koz_fault(const koz_situation *now)
{
    int zone;
@WHEELS@    int wheel;
    if (!is_direction(now->q_BN, 4)) return "q_BN: must be finite and not zero";
    if (!is_direction(now->q_DN, 4)) return "q_DN: must be finite and not zero";
    if (!(koz_dot(now->omega_BN_B, now->omega_BN_B) < 1e12f)) return "omega_BN_B: must be finite";
@WHEELS@    for (wheel = 0; wheel < KOZ_WHEELS; wheel++)
@WHEELS@        if (!(fabsf(now->wheel_momentum[wheel]) < 1e12f)) return "wheel_momentum: must be finite";
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        if (!(fabsf(now->zone_half_angle[zone]) <= pi)) return "zone_half_angle: must be at most pi in radians";
        if (!is_direction(now->zone_axis_N[zone], 3) && now->zone_half_angle[zone] > 0.0f)
            return "zone_axis_N: must be finite and not zero";
@SEVERAL@        if (koz_instrument(now->zone_instrument[zone]) != now->zone_instrument[zone])
@SEVERAL@            return "zone_instrument: must be at least 0 and below KOZ_INSTRUMENTS";
    }
    return NULL;
}

/* conjugate(a) (x) b */
static void relative(const float a[4], const float b[4], float q[4])
{
    q[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    q[1] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
    q[2] = a[0] * b[2] - a[2] * b[0] - a[3] * b[1] + a[1] * b[3];
    q[3] = a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1];
}

/* The attitude error: of q_e and -q_e the one nearer to what the memory holds, which it replaces. */
static void remember(koz_memory *memory, const koz_situation *unit)
{
    float q_e[4], along = 0.0f;
    int i;
    relative(unit->q_DN, unit->q_BN, q_e);
    for (i = 0; i < 4; i++) along += q_e[i] * memory->q_e[i];
    for (i = 0; i < 4; i++) memory->q_e[i] = along < 0.0f ? -q_e[i] : q_e[i];
}

void koz_start(koz_memory *memory, const koz_situation *now)
{
    const koz_memory on_target = {{1.0f, 0.0f, 0.0f, 0.0f}@MEMORY_START@};
    const koz_situation unit = koz_unit_situation(now);
    *memory = on_target;
    remember(memory, &unit);
@WHEELS@    koz_wheels_limits(&unit, memory->torque_limit);
}

@SPACECRAFT@/* Unit vector from the boresight towards a zone's axis; zero where the two coincide. */
static void zone_direction(const koz_situation *unit, int zone, float direction_B[3])
{
    float to_body[4], axis_B[3];
    int i;
    koz_conjugate(unit->q_BN, to_body);
    koz_rotate(to_body, unit->zone_axis_N[zone], axis_B);
    for (i = 0; i < 3; i++) direction_B[i] = axis_B[i] - koz_boresight_B@OF_UNIT_ZONE@[i];
    koz_to_unit(direction_B, 3);
}

void koz_observe(koz_memory *memory, const koz_situation *now, float observation[KOZ_OBSERVATION_SIZE])
{
    const koz_situation unit = koz_unit_situation(now);
    float angle[KOZ_ZONES], margin[KOZ_ZONES], boresight_N[3];
    int seen[KOZ_ZONES];
    int i, zone, place, nearest;
@OBSERVE_BODY@@ONE@    koz_rotate(unit.q_BN, koz_boresight_B, boresight_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
@SEVERAL@        koz_rotate(unit.q_BN, koz_boresight_B[unit.zone_instrument[zone]], boresight_N);
        angle[zone] = koz_angle(boresight_N, unit.zone_axis_N[zone]);
        margin[zone] = angle[zone] - unit.zone_half_angle[zone];
        seen[zone] = 0;
    }
    for (place = 0; place < KOZ_OBSERVED_ZONES; place++) {
        float *part = observation + @ZONE_PLACE@;
        nearest = -1;
        for (zone = 0; zone < KOZ_ZONES; zone++)
            if (!seen[zone] && (nearest < 0 || margin[zone] < margin[nearest])) nearest = zone;
        seen[nearest] = 1;
        part[0] = margin[nearest];
        part[1] = angle[nearest];
@ZONE_DIRECTION@        if (@WHICH_ABSENT@unit.zone_half_angle[nearest] <= 0.0f) {
            part[0] = part[1] = pi;
            part[2] = part[3] = part[4] = 0.0f;
@ABSENT_BORESIGHT@        }
    }
@OBSERVE_SPACECRAFT@}

/* y = x kernel + bias; about half of what a layer gives is zero, and is passed over */
static void dense(const float *x, int inputs, const float *kernel, const float *bias, int outputs, float *y)
{
    int i, j;
    for (j = 0; j < outputs; j++) y[j] = bias[j];
    for (i = 0; i < inputs; i++) {
        const float value = x[i];
        const float *row = kernel + i * outputs;
        if (!(fabsf(value) <= 0.0f)) /* what is not a number is not passed over */
            for (j = 0; j < outputs; j++) y[j] += value * row[j];
    }
}

@HELPERS@void koz_decide(const float observation[KOZ_OBSERVATION_SIZE], float action[KOZ_ACTION_SIZE])
{
@DECIDE@
}

@FORGETS@void koz_torque(const float observation[KOZ_OBSERVATION_SIZE], float torque_B[KOZ_ACTION_SIZE])
@REMEMBERS@void koz_torque(const koz_memory *memory, const float observation[KOZ_OBSERVATION_SIZE],
@REMEMBERS@    float torque_B[KOZ_ACTION_SIZE])
{
@TORQUE@}
@WHEELS@
@WHEELS@void koz_wheel_torques(const koz_situation *now, const float torque_B[3], float wheel_torque[KOZ_WHEELS])
@WHEELS@{
@WHEELS@    int wheel;
@WHEELS@    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) wheel_torque[wheel] = 0.0f;
@WHEELS@    if (koz_fault(now) == NULL) koz_wheels_allocate(now, torque_B, wheel_torque);
@WHEELS@}
