/*
 * Reaction wheels: what they leave of the torque limits, how fast the body may turn, and what each wheel has to do.
 *
@HEAD@
 */
#ifndef KOZ_WHEELS_H
#define KOZ_WHEELS_H

#include <math.h>

#include "koz_math.h"

#if KOZ_EXPORT_ID != @EXPORT_ID@
#error "koz_wheels.h and koz_policy.h are of different exports"
#endif

static const float koz_wheel_axis_B[KOZ_WHEELS][3] = {@WHEEL_AXES@};
static const float koz_wheel_allocation[KOZ_WHEELS][3] = {@ALLOCATION@}; /* torque of each per torque on the body */
static const float koz_wheel_allocated[KOZ_WHEELS] = {@ALLOCATED@}; /* norms of its rows */
static const float koz_wheel_corner[KOZ_WHEELS] = {@CORNER@}; /* [N m] largest of each at rest within the limits */
static const float koz_wheel_max_torque[KOZ_WHEELS] = {@WHEEL_MAX_TORQUE@}; /* [N m] */
static const float koz_wheel_max_momentum[KOZ_WHEELS] = {@WHEEL_MAX_MOMENTUM@}; /* [N m s] */
static const float koz_wheel_least_share = @LEAST_SHARE@; /* of the torque limits, which is never less */
static const float koz_wheel_reserve = @RESERVE@; /* [N m] for the gyroscopic torque up to the largest rate */
static const float koz_wheel_max_rate = @MAX_RATE@; /* [rad/s] that the body may have on any wheels */
static const float koz_body_inertia[3][3] = {@BODY_INERTIA@}; /* [kg m^2] */
static const float koz_body_inverse_inertia[3][3] = {@BODY_INVERSE_INERTIA@};
static const float koz_body_largest_moment = @BODY_LARGEST_MOMENT@; /* [kg m^2] of inertia */
static const float koz_body_moment_difference = @BODY_MOMENT_DIFFERENCE@; /* [kg m^2] to the smallest */

/* Angular momentum of all wheels [N m s] in body axes. */
static inline void koz_wheels_momentum(const koz_situation *now, float held_B[3])
{
    int i, wheel;
    for (i = 0; i < 3; i++) {
        held_B[i] = 0.0f;
        for (wheel = 0; wheel < KOZ_WHEELS; wheel++)
            held_B[i] += koz_wheel_axis_B[wheel][i] * now->wheel_momentum[wheel];
    }
}

/* Share of the torque limits that is left beside what the wheels' own momentum takes while the body turns. */
static inline float koz_wheels_share(const koz_situation *now)
{
    float held_B[3], taken_B[3], room, share = 1.0f;
    int wheel;
    koz_wheels_momentum(now, held_B);
    koz_cross(now->omega_BN_B, held_B, taken_B);
    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) {
        room = koz_wheel_max_torque[wheel] - fabsf(koz_dot(koz_wheel_allocation[wheel], taken_B));
        room /= koz_wheel_corner[wheel];
        share = room < share ? room : share;
    }
    return share < koz_wheel_least_share ? koz_wheel_least_share : share;
}

/* What is left of the torque limits [N m]. */
static inline void koz_wheels_limits(const koz_situation *now, float limit_B[3])
{
    const float share = koz_wheels_share(now);
    int i;
    for (i = 0; i < 3; i++) limit_B[i] = share * @LIMIT_OF_I@;
}

/*
 * Rate [rad/s] up to which the body can be turned and stopped at any attitude: no wheel is full, and what their
 * momentum takes is no more than the reserve.
 */
static inline float koz_wheels_largest_rate(const koz_situation *now)
{
    float held_B[3], total_B[3], total, idle, room, divisor, by_momentum = INFINITY, by_torque, rate;
    int i, wheel;
    koz_wheels_momentum(now, held_B);
    for (i = 0; i < 3; i++) total_B[i] = koz_dot(koz_body_inertia[i], now->omega_BN_B) + held_B[i];
    total = koz_norm(total_B);
    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) {
        idle = fabsf(now->wheel_momentum[wheel] - koz_dot(koz_wheel_allocation[wheel], held_B));
        room = (koz_wheel_max_momentum[wheel] - idle) / koz_wheel_allocated[wheel];
        by_momentum = room < by_momentum ? room : by_momentum;
    }
    by_momentum = (by_momentum - total) / koz_body_largest_moment;
    divisor = total + sqrtf(total * total + 2.0f * koz_body_moment_difference * koz_wheel_reserve);
    by_torque = divisor > 0.0f ? 2.0f * koz_wheel_reserve / divisor : INFINITY;
    rate = by_torque < by_momentum ? by_torque : by_momentum;
    rate = koz_wheel_max_rate < rate ? koz_wheel_max_rate : rate;
    return rate < 0.0f ? 0.0f : rate;
}

/*
 * Torque that each wheel gives the body for a time step [N m] where torque_B is to turn it.  They add what their
 * momentum takes in the middle of the step, share it out by the least norm, and give less of all of it where one of
 * them is at the end of its torque or of its momentum.
 */
static inline void koz_wheels_allocate(
    const koz_situation *now, const float torque_B[3], float wheel_torque[KOZ_WHEELS])
{
    const float half = 0.5f * KOZ_STEP_SECONDS, *omega_B = now->omega_BN_B;
    float wanted_B[3], held_B[3], momentum_B[3], turned_B[3], net_B[3], omega_middle_B[3], held_middle_B[3];
    float size, room, share = 1.0f;
    int i, wheel;
    koz_wheels_limits(now, wanted_B);
    koz_wheels_momentum(now, held_B);
    for (i = 0; i < 3; i++) {
        const float asked = torque_B[i], limit = wanted_B[i];
        wanted_B[i] = asked > limit ? limit : asked < -limit ? -limit : asked;
        if (!(fabsf(wanted_B[i]) <= limit)) wanted_B[i] = 0.0f; /* not a number */
        momentum_B[i] = koz_dot(koz_body_inertia[i], omega_B);
    }
    koz_cross(momentum_B, omega_B, net_B);
    for (i = 0; i < 3; i++) net_B[i] += wanted_B[i];
    koz_cross(held_B, omega_B, turned_B);
    for (i = 0; i < 3; i++) {
        omega_middle_B[i] = omega_B[i] + half * koz_dot(koz_body_inverse_inertia[i], net_B);
        held_middle_B[i] = held_B[i] + half * (turned_B[i] - wanted_B[i]);
    }
    koz_cross(omega_middle_B, held_middle_B, net_B);
    for (i = 0; i < 3; i++) net_B[i] += wanted_B[i];
    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) {
        const float each = koz_dot(koz_wheel_allocation[wheel], net_B);
        const float held = each > 0.0f ? now->wheel_momentum[wheel] : -now->wheel_momentum[wheel];
        wheel_torque[wheel] = each;
        room = (koz_wheel_max_momentum[wheel] + held) / KOZ_STEP_SECONDS;
        room = room < koz_wheel_max_torque[wheel] ? room : koz_wheel_max_torque[wheel];
        size = fabsf(each);
        if (size > 0.0f && size * share > room) share = room > 0.0f ? room / size : 0.0f;
    }
    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) wheel_torque[wheel] *= share;
}

#endif
