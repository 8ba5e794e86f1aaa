/*
@HEAD@
 */
#include "koz_policy.h"

#include <math.h>

static const float boresight_B[3] = {@BORESIGHT@};

@WEIGHTS@

/* conjugate(a) (x) b */
static void relative(const float a[4], const float b[4], float q[4])
{
    q[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    q[1] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
    q[2] = a[0] * b[2] - a[2] * b[0] - a[3] * b[1] + a[1] * b[3];
    q[3] = a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1];
}

static void cross(const float a[3], const float b[3], float c[3])
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* q (x) (0, v) (x) q*, with q = (q0, q_vec) */
static void rotate(float q0, const float q_vec[3], const float v[3], float turned[3])
{
    float t[3], u[3];
    int i;
    cross(q_vec, v, t);
    for (i = 0; i < 3; i++) t[i] *= 2.0f;
    cross(q_vec, t, u);
    for (i = 0; i < 3; i++) turned[i] = v[i] + q0 * t[i] + u[i];
}

static float norm(const float v[3])
{
    return sqrtf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

float koz_start(const koz_situation *now)
{
    float q_e[4];
    relative(now->q_DN, now->q_BN, q_e);
    return q_e[0];
}

void koz_observe(const koz_situation *now, float observation[KOZ_OBSERVATION_SIZE])
{
    const float inverse[3] = {-now->q_BN[1], -now->q_BN[2], -now->q_BN[3]};
    float axis_B[3], boresight_N[3], offset_B[3], difference_N[3], sum_N[3];
    float distance, angle;
    int i;
    rotate(now->q_BN[0], inverse, now->zone_axis_N, axis_B);
    rotate(now->q_BN[0], now->q_BN + 1, boresight_B, boresight_N);
    for (i = 0; i < 3; i++) {
        offset_B[i] = axis_B[i] - boresight_B[i];
        difference_N[i] = boresight_N[i] - now->zone_axis_N[i];
        sum_N[i] = boresight_N[i] + now->zone_axis_N[i];
    }
    distance = norm(offset_B);
    angle = 2.0f * atan2f(norm(difference_N), norm(sum_N));
    relative(now->q_DN, now->q_BN, observation);
    for (i = 0; i < 3; i++) {
        observation[4 + i] = now->omega_BN_B[i];
        observation[7 + i] = boresight_B[i];
        observation[12 + i] = distance > 0.0f ? offset_B[i] / distance : 0.0f;
    }
    observation[10] = angle - now->zone_half_angle;
    observation[11] = angle;
    observation[15] = now->q_e0_previous;
}

/* y = x kernel + bias */
static void dense(const float *x, int inputs, const float *kernel, const float *bias, int outputs, float *y)
{
    int i, j;
    for (j = 0; j < outputs; j++) y[j] = bias[j];
    for (i = 0; i < inputs; i++)
        for (j = 0; j < outputs; j++) y[j] += x[i] * kernel[i * outputs + j];
}

@RELU@void koz_decide(const float observation[KOZ_OBSERVATION_SIZE], float action[KOZ_ACTION_SIZE])
{
@DECIDE@
}

void koz_torque(const float observation[KOZ_OBSERVATION_SIZE], float torque_B[KOZ_ACTION_SIZE])
{
    int i;
    koz_decide(observation, torque_B);
    for (i = 0; i < KOZ_ACTION_SIZE; i++) torque_B[i] *= KOZ_TORQUE_LIMIT;
}
