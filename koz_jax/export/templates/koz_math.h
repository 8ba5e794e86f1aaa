/*
 * Vectors and scalar-first quaternions, for koz_policy.c and koz_shield.c.
 *
@HEAD@
 */
#ifndef KOZ_MATH_H
#define KOZ_MATH_H

#include <math.h>

#include "koz_policy.h"

static const float koz_boresight_B@OF_INSTRUMENTS@[3] = {@BORESIGHT@};

static inline float koz_dot(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline float koz_norm(const float v[3])
{
    return sqrtf(koz_dot(v, v));
}

static inline void koz_cross(const float a[3], const float b[3], float c[3])
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* q (x) (0, v) (x) q*: with q_BN, body components to inertial ones */
static inline void koz_rotate(const float q[4], const float v[3], float turned[3])
{
    float t[3], u[3];
    int i;
    koz_cross(q + 1, v, t);
    for (i = 0; i < 3; i++) t[i] *= 2.0f;
    koz_cross(q + 1, t, u);
    for (i = 0; i < 3; i++) turned[i] = v[i] + q[0] * t[i] + u[i];
}

static inline void koz_conjugate(const float q[4], float conjugate[4])
{
    conjugate[0] = q[0];
    conjugate[1] = -q[1];
    conjugate[2] = -q[2];
    conjugate[3] = -q[3];
}

/* Angle between two unit vectors [rad]. */
static inline float koz_angle(const float a[3], const float b[3])
{
    float difference[3], sum[3];
    int i;
    for (i = 0; i < 3; i++) {
        difference[i] = a[i] - b[i];
        sum[i] = a[i] + b[i];
    }
    return 2.0f * atan2f(koz_norm(difference), koz_norm(sum));
}

/* The same direction with length 1; zero stays zero. */
static inline void koz_to_unit(float *v, int size)
{
    float squared = 0.0f;
    int i;
    for (i = 0; i < size; i++) squared += v[i] * v[i];
    for (i = 0; i < size; i++) v[i] = squared > 0.0f ? v[i] / sqrtf(squared) : v[i];
}

@SEVERAL@/* The number of an instrument; 0 in place of what is none, so that nothing else is read. */
@SEVERAL@static inline int koz_instrument(int number)
@SEVERAL@{
@SEVERAL@    return number >= 0 && number < KOZ_INSTRUMENTS ? number : 0;
@SEVERAL@}
@SEVERAL@
/* The same situation with quaternions and axes of unit length. */
static inline koz_situation koz_unit_situation(const koz_situation *given)
{
    koz_situation unit = *given;
    int zone;
    koz_to_unit(unit.q_BN, 4);
    koz_to_unit(unit.q_DN, 4);
    for (zone = 0; zone < KOZ_ZONES; zone++) koz_to_unit(unit.zone_axis_N[zone], 3);
@SEVERAL@    for (zone = 0; zone < KOZ_ZONES; zone++) unit.zone_instrument[zone] = koz_instrument(unit.zone_instrument[zone]);
    return unit;
}

#endif
