/*
 * The loop around the controller, closed on a rigid body: @EXAMPLE@.
 * make example, or: cc -std=c99 -O2 -o koz_example koz_policy.c koz_example.c -lm && ./koz_example
 * With the shield in between: add -DKOZ_WITH_SHIELD and koz_shield.c.
 *
@HEAD@
 */
#include <math.h>
#include <stdio.h>

#include "koz_policy.h"
#ifdef KOZ_WITH_SHIELD
#include "koz_shield.h"
#endif

#define STEPS @STEPS@
#define ROW_STEPS @ROW_STEPS@ /* from one printed row to the next */
#define SUBSTEPS 10 /* of the body in a time step of the controller */
#define SETTLED_DEG @SETTLED_DEG@

static const double degrees = 57.29577951308232;
static const double boresight_B@OF_INSTRUMENTS@[3] = {@EXACT_BORESIGHT@};
static const double inertia[3][3] = {@EXACT_INERTIA@}; /* [kg m^2] */
static const double inverse_inertia[3][3] = {@EXACT_INVERSE_INERTIA@};
@WHEELS@static const double wheel_axis_B[KOZ_WHEELS][3] = {@EXACT_WHEEL_AXES@};
@WHEELS@static const double wheel_max_momentum[KOZ_WHEELS] = {@EXACT_MAX_MOMENTUM@}; /* [N m s] */

typedef struct {
    double q_BN[4];
    double omega_BN_B[3];
@WHEELS@    double wheel_momentum[KOZ_WHEELS]; /* [N m s] */
} rigid_body;

static void cross(const double a[3], const double b[3], double c[3])
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

@WHEELS@/* Angular momentum of the body and its wheels [N m s] in body axes. */
@WHEELS@static void total_momentum(const rigid_body *at, double momentum_B[3])
@WHEELS@{
@WHEELS@    int i, wheel;
@WHEELS@    for (i = 0; i < 3; i++) {
@WHEELS@        momentum_B[i] = dot(inertia[i], at->omega_BN_B);
@WHEELS@        for (wheel = 0; wheel < KOZ_WHEELS; wheel++)
@WHEELS@            momentum_B[i] += wheel_axis_B[wheel][i] * at->wheel_momentum[wheel];
@WHEELS@    }
@WHEELS@}
@WHEELS@
/* Euler's equation and kinematics. */
@NO_WHEELS@static void derivative(const rigid_body *at, const float torque_B[3], rigid_body *slope)
@WHEELS@static void derivative(const rigid_body *at, const float wheel_torque[KOZ_WHEELS], rigid_body *slope)
{
    const double *q = at->q_BN, *w = at->omega_BN_B;
    double momentum_B[3], net_B[3], turned[3];
@NO_WHEELS@    int i;
@NO_WHEELS@    for (i = 0; i < 3; i++) momentum_B[i] = dot(inertia[i], w);
@WHEELS@    int i, wheel;
@WHEELS@    total_momentum(at, momentum_B);
    cross(momentum_B, w, net_B);
    cross(q + 1, w, turned);
@NO_WHEELS@    for (i = 0; i < 3; i++) net_B[i] += (double)torque_B[i];
@WHEELS@    for (wheel = 0; wheel < KOZ_WHEELS; wheel++) {
@WHEELS@        for (i = 0; i < 3; i++) net_B[i] += wheel_axis_B[wheel][i] * (double)wheel_torque[wheel];
@WHEELS@        slope->wheel_momentum[wheel] = -(double)wheel_torque[wheel];
@WHEELS@    }
    slope->q_BN[0] = -0.5 * dot(q + 1, w);
    for (i = 0; i < 3; i++) slope->q_BN[1 + i] = 0.5 * (q[0] * w[i] + turned[i]);
    for (i = 0; i < 3; i++) slope->omega_BN_B[i] = dot(inverse_inertia[i], net_B);
}

static void ahead(const rigid_body *from, const rigid_body *slope, double h, rigid_body *to)
{
    int i;
    for (i = 0; i < 4; i++) to->q_BN[i] = from->q_BN[i] + h * slope->q_BN[i];
    for (i = 0; i < 3; i++) to->omega_BN_B[i] = from->omega_BN_B[i] + h * slope->omega_BN_B[i];
@WHEELS@    for (i = 0; i < KOZ_WHEELS; i++) to->wheel_momentum[i] = from->wheel_momentum[i] + h * slope->wheel_momentum[i];
}

/* Turn the body for a while with a constant torque (Runge-Kutta of order 4). */
static void fly(rigid_body *body, const float @HELD_TORQUE@, double seconds)
{
    rigid_body k1, k2, k3, k4, at;
    derivative(body, @HELD@, &k1);
    ahead(body, &k1, 0.5 * seconds, &at);
    derivative(&at, @HELD@, &k2);
    ahead(body, &k2, 0.5 * seconds, &at);
    derivative(&at, @HELD@, &k3);
    ahead(body, &k3, seconds, &at);
    derivative(&at, @HELD@, &k4);
    ahead(body, &k1, seconds / 6.0, body);
    ahead(body, &k2, seconds / 3.0, body);
    ahead(body, &k3, seconds / 3.0, body);
    ahead(body, &k4, seconds / 6.0, body);
}

@WHEELS@/* The total angular momentum [N m s] in inertial axes, where it stays. */
@WHEELS@static void inertial_momentum(const rigid_body *body, double momentum_N[3])
@WHEELS@{
@WHEELS@    const double *q = body->q_BN, squared = q[0] * q[0] + dot(q + 1, q + 1);
@WHEELS@    double momentum_B[3], t[3], u[3];
@WHEELS@    int i;
@WHEELS@    total_momentum(body, momentum_B);
@WHEELS@    cross(q + 1, momentum_B, t);
@WHEELS@    cross(q + 1, t, u);
@WHEELS@    for (i = 0; i < 3; i++) momentum_N[i] = momentum_B[i] + 2.0 * (q[0] * t[i] + u[i]) / squared;
@WHEELS@}
@WHEELS@
/* What sensors measure.  Like many a star tracker they give attitudes with a scalar part that is not negative. */
static void measure(const rigid_body *body, koz_situation *now)
{
    const double size = sqrt(body->q_BN[0] * body->q_BN[0] + dot(body->q_BN + 1, body->q_BN + 1));
    const double scale = (body->q_BN[0] < 0.0 ? -1.0 : 1.0) / size;
    int i;
    for (i = 0; i < 4; i++) now->q_BN[i] = (float)(scale * body->q_BN[i]);
    for (i = 0; i < 3; i++) now->omega_BN_B[i] = (float)body->omega_BN_B[i];
@WHEELS@    for (i = 0; i < KOZ_WHEELS; i++) now->wheel_momentum[i] = (float)body->wheel_momentum[i];
}

/* Angle between the attitude and the target [deg]. */
static double pointing_error(const koz_situation *now)
{
    double along = 0.0, squared = 0.0, apart;
    int i;
    for (i = 0; i < 4; i++) along += (double)now->q_DN[i] * (double)now->q_BN[i];
    for (i = 0; i < 4; i++) {
        apart = (double)now->q_BN[i] - (along < 0.0 ? -1.0 : 1.0) * (double)now->q_DN[i];
        squared += apart * apart;
    }
    return 4.0 * asin(0.5 * sqrt(squared)) * degrees;
}

/* Angle between the telescope and the nearest zone's edge [deg]. */
static double smallest_margin(const koz_situation *now)
{
    double q[4], looking_N[3], t[3], u[3], axis_N[3], apart[3], margin, smallest = 360.0;
    int i, zone;
    for (i = 0; i < 4; i++) q[i] = (double)now->q_BN[i];
@ONE@    cross(q + 1, boresight_B, t);
@ONE@    cross(q + 1, t, u);
@ONE@    for (i = 0; i < 3; i++) looking_N[i] = boresight_B[i] + 2.0 * (q[0] * t[i] + u[i]);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
@SEVERAL@        const double *look_B = boresight_B[now->zone_instrument[zone]];
@SEVERAL@        cross(q + 1, look_B, t);
@SEVERAL@        cross(q + 1, t, u);
@SEVERAL@        for (i = 0; i < 3; i++) looking_N[i] = look_B[i] + 2.0 * (q[0] * t[i] + u[i]);
        for (i = 0; i < 3; i++) axis_N[i] = (double)now->zone_axis_N[zone][i];
        cross(looking_N, axis_N, apart);
        margin = atan2(sqrt(dot(apart, apart)), dot(looking_N, axis_N)) - (double)now->zone_half_angle[zone];
        smallest = fmin(smallest, margin * degrees);
    }
    return smallest;
}

int main(void)
{
    koz_situation now = @SITUATION@;
    koz_memory memory;
    rigid_body body;
    float observation[KOZ_OBSERVATION_SIZE], requested_B[3], torque_B[3];
@WHEELS@    float wheel_torque[KOZ_WHEELS];
@WHEELS@    double start_N[3], end_N[3], changed = 0.0, fullest = 0.0;
    double error, margin, smallest = 360.0, settled_at = 0.0;
    int i, step, substep;

    for (i = 0; i < 4; i++) body.q_BN[i] = (double)now.q_BN[i];
    for (i = 0; i < 3; i++) body.omega_BN_B[i] = (double)now.omega_BN_B[i];
@WHEELS@    for (i = 0; i < KOZ_WHEELS; i++) body.wheel_momentum[i] = (double)now.wheel_momentum[i];
@WHEELS@    inertial_momentum(&body, start_N);
    printf("%8s %20s %18s\n", "time [s]", "pointing error [deg]", "margin [deg]");

    /* Once, at the start of a maneuver. */
    measure(&body, &now);
    koz_start(&memory, &now);
    for (step = 0; step <= STEPS; step++) {
        /* Every KOZ_STEP_SECONDS: measure, check, observe, decide, shield, apply. */
        measure(&body, &now);
        if (koz_fault(&now)) {
            printf("%s\n", koz_fault(&now));
            return 1;
        }
        koz_observe(&memory, &now, observation);
        koz_torque(@MEMORY_ARGUMENT@observation, requested_B);
#ifdef KOZ_WITH_SHIELD
        koz_shield(&now, requested_B, torque_B);
#else
        for (i = 0; i < 3; i++) torque_B[i] = requested_B[i];
#endif
@WHEELS@        koz_wheel_torques(&now, torque_B, wheel_torque);
        error = pointing_error(&now);
        margin = smallest_margin(&now);
        if (step % ROW_STEPS == 0)
            printf("%8.1f %20.3f %18.3f\n", step * (double)KOZ_STEP_SECONDS, error, margin);
        if (!(error <= SETTLED_DEG)) settled_at = (step + 1) * (double)KOZ_STEP_SECONDS;
        smallest = fmin(smallest, margin);
        for (substep = 0; substep < SUBSTEPS && step < STEPS; substep++) {
            fly(&body, @HELD@, (double)KOZ_STEP_SECONDS / SUBSTEPS);
            measure(&body, &now);
            smallest = fmin(smallest, smallest_margin(&now));
        }
@WHEELS@        for (i = 0; i < KOZ_WHEELS; i++)
@WHEELS@            fullest = fmax(fullest, fabs(body.wheel_momentum[i]) / wheel_max_momentum[i]);
    }
@WHEELS@    inertial_momentum(&body, end_N);
@WHEELS@    for (i = 0; i < 3; i++) changed = fmax(changed, fabs(end_N[i] - start_N[i]));
@WHEELS@    printf("wheels: at most %.1f %% full; total angular momentum changed by %.1e N m s\n", 100.0 * fullest, changed);
    if (settled_at <= STEPS * (double)KOZ_STEP_SECONDS)
        printf("settled within %.2f deg in %.1f s, ", SETTLED_DEG, settled_at);
    else
        printf("not settled, ");
    printf("smallest margin %.3f deg: %s\n", smallest, smallest > 0.0 ? "stayed clear" : "ENTERED A ZONE");
    return smallest > 0.0 && settled_at <= STEPS * (double)KOZ_STEP_SECONDS ? 0 : 1;
}
