/*
@HEAD@
 */
#include "koz_policy.h"

#include "koz_math.h"

@WEIGHTS@

/* conjugate(a) (x) b */
static void relative(const float a[4], const float b[4], float q[4])
{
    q[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    q[1] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
    q[2] = a[0] * b[2] - a[2] * b[0] - a[3] * b[1] + a[1] * b[3];
    q[3] = a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1];
}

float koz_start(const koz_situation *now)
{
    float q_e[4];
    relative(now->q_DN, now->q_BN, q_e);
    return q_e[0];
}

/* Unit vector from the boresight towards a zone's axis; zero where the two coincide. */
static void zone_direction(const koz_situation *now, int zone, float direction_B[3])
{
    float to_body[4], axis_B[3], distance;
    int i;
    koz_conjugate(now->q_BN, to_body);
    koz_rotate(to_body, now->zone_axis_N[zone], axis_B);
    for (i = 0; i < 3; i++) direction_B[i] = axis_B[i] - koz_boresight_B[i];
    distance = koz_norm(direction_B);
    for (i = 0; i < 3; i++) direction_B[i] = distance > 0.0f ? direction_B[i] / distance : 0.0f;
}

void koz_observe(const koz_situation *now, float observation[KOZ_OBSERVATION_SIZE])
{
    float angle[KOZ_ZONES], margin[KOZ_ZONES], boresight_N[3];
    int seen[KOZ_ZONES];
    int i, zone, place, nearest;
    relative(now->q_DN, now->q_BN, observation);
    for (i = 0; i < 3; i++) {
        observation[4 + i] = now->omega_BN_B[i];
        observation[7 + i] = koz_boresight_B[i];
    }
    observation[15] = now->q_e0_previous;
    koz_rotate(now->q_BN, koz_boresight_B, boresight_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        angle[zone] = koz_angle(boresight_N, now->zone_axis_N[zone]);
        margin[zone] = angle[zone] - now->zone_half_angle[zone];
        seen[zone] = 0;
    }
    for (place = 0; place < KOZ_OBSERVED_ZONES; place++) {
        float *part = observation + (place == 0 ? 10 : 11 + 5 * place);
        nearest = -1;
        for (zone = 0; zone < KOZ_ZONES; zone++)
            if (!seen[zone] && (nearest < 0 || margin[zone] < margin[nearest])) nearest = zone;
        seen[nearest] = 1;
        part[0] = margin[nearest];
        part[1] = angle[nearest];
        zone_direction(now, nearest, part + 2);
        if (place > 0 && now->zone_half_angle[nearest] <= 0.0f) {
            part[0] = part[1] = koz_pi;
            part[2] = part[3] = part[4] = 0.0f;
        }
    }
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
    for (i = 0; i < KOZ_ACTION_SIZE; i++) torque_B[i] *= @LIMIT_OF_I@;
}
