/*
 * See koz_shield.h.
 *
@HEAD@
 */
#include "koz_shield.h"

#include "koz_math.h"

#if KOZ_EXPORT_ID != @EXPORT_ID@
#error "this shield and koz_policy.h are of different exports"
#endif

#define SAMPLES @SAMPLES@
#define CANDIDATES 3 /* before the brake, which is what is left when all are refused */

static const float inertia[3][3] = {@INERTIA@};
static const float inverse_inertia[3][3] = {@INVERSE_INERTIA@};
static const float shield_margin = @MARGIN@;             /* [rad] */
static const float brake_limit = @BRAKE_TORQUE@;         /* [N m] norm of the torque that brakes */
static const float arc_error = @ARC_ERROR@;              /* relative error of a brake path */
static const float rate_error = @RATE_ERROR@;            /* [rad/s] error of the rate with which it begins */
static const float guide_rate = @GUIDE_RATE@;            /* [rad/s] around a zone */
static const float smallest_moment = @SMALLEST_MOMENT@;  /* [kg m^2] */
static const float largest_moment = @LARGEST_MOMENT@;
static const float guide_seconds = @GUIDE_SECONDS@;      /* [s] in which the guide takes up its rate */

typedef struct {
    float q_BN[4];
    float omega_BN_B[3];
} body_state;

/* Vectors in body axes that are fixed in inertial ones: the angular momentum first, then the zones' axes. */
typedef struct {
    float v[1 + KOZ_ZONES][3];
} coast;

static void multiply(const float m[3][3], const float v[3], float product[3])
{
    int i;
    for (i = 0; i < 3; i++) product[i] = koz_dot(m[i], v);
}

static float smaller(float a, float b)
{
    return a < b ? a : b;
}

static float larger(float a, float b)
{
    return a > b ? a : b;
}

/* Euler's equation and kinematics. */
static void derivative(const body_state *at, const float torque_B[3], body_state *slope)
{
    const float *q = at->q_BN, *w = at->omega_BN_B;
    float momentum_B[3], gyroscopic_B[3], net_B[3];
    int i;
    slope->q_BN[0] = 0.5f * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2]);
    slope->q_BN[1] = 0.5f * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
    slope->q_BN[2] = 0.5f * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]);
    slope->q_BN[3] = 0.5f * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
    multiply(inertia, w, momentum_B);
    koz_cross(w, momentum_B, gyroscopic_B);
    for (i = 0; i < 3; i++) net_B[i] = torque_B[i] - gyroscopic_B[i];
    multiply(inverse_inertia, net_B, slope->omega_BN_B);
}

static void ahead(const body_state *from, const body_state *slope, float h, body_state *to)
{
    int i;
    for (i = 0; i < 4; i++) to->q_BN[i] = from->q_BN[i] + h * slope->q_BN[i];
    for (i = 0; i < 3; i++) to->omega_BN_B[i] = from->omega_BN_B[i] + h * slope->omega_BN_B[i];
}

static float mean_slope(float a, float b, float c, float d)
{
    return (a + 2.0f * (b + c) + d) / 6.0f;
}

/* One time step with the torque held (Runge-Kutta of order 4). */
static void push(const body_state *from, const float torque_B[3], body_state *to)
{
    const float dt = KOZ_STEP_SECONDS;
    body_state k1, k2, k3, k4, mean, at;
    float size;
    int i;
    derivative(from, torque_B, &k1);
    ahead(from, &k1, 0.5f * dt, &at);
    derivative(&at, torque_B, &k2);
    ahead(from, &k2, 0.5f * dt, &at);
    derivative(&at, torque_B, &k3);
    ahead(from, &k3, dt, &at);
    derivative(&at, torque_B, &k4);
    for (i = 0; i < 4; i++) mean.q_BN[i] = mean_slope(k1.q_BN[i], k2.q_BN[i], k3.q_BN[i], k4.q_BN[i]);
    for (i = 0; i < 3; i++)
        mean.omega_BN_B[i] = mean_slope(k1.omega_BN_B[i], k2.omega_BN_B[i], k3.omega_BN_B[i], k4.omega_BN_B[i]);
    ahead(from, &mean, dt, to);
    size = sqrtf(to->q_BN[0] * to->q_BN[0] + koz_dot(to->q_BN + 1, to->q_BN + 1));
    for (i = 0; i < 4; i++) to->q_BN[i] /= size;
}

/* Fixed vectors seen from the turning body: v' = v x w. */
static void coast_slope(const coast *at, coast *slope)
{
    float omega_B[3];
    int n;
    multiply(inverse_inertia, at->v[0], omega_B);
    for (n = 0; n <= KOZ_ZONES; n++) koz_cross(at->v[n], omega_B, slope->v[n]);
}

static void coast_ahead(const coast *from, const coast *slope, float h, coast *to)
{
    int n, i;
    for (n = 0; n <= KOZ_ZONES; n++)
        for (i = 0; i < 3; i++) to->v[n][i] = from->v[n][i] + h * slope->v[n][i];
}

/* Torque-free motion over a piece of the brake path. */
static void coast_on(coast *at, float seconds)
{
    coast k1, k2, k3, k4, mean, tried;
    int n, i;
    coast_slope(at, &k1);
    coast_ahead(at, &k1, 0.5f * seconds, &tried);
    coast_slope(&tried, &k2);
    coast_ahead(at, &k2, 0.5f * seconds, &tried);
    coast_slope(&tried, &k3);
    coast_ahead(at, &k3, seconds, &tried);
    coast_slope(&tried, &k4);
    for (n = 0; n <= KOZ_ZONES; n++)
        for (i = 0; i < 3; i++) mean.v[n][i] = mean_slope(k1.v[n][i], k2.v[n][i], k3.v[n][i], k4.v[n][i]);
    tried = *at;
    coast_ahead(&tried, &mean, seconds, at);
}

/* Whether the boresight is farther than the tolerance [rad] from all zones, its cosines being too small by bulge. */
static int clear(const koz_situation *now, const coast *at, float bulge, float tolerance)
{
    int zone;
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        const float half_angle = now->zone_half_angle[zone];
        const float cosine = cosf(half_angle);
        const float shrunk = cosine > 0.0f ? cosine * (1.0f - 0.5f * tolerance * tolerance) : cosine;
        const float found = koz_dot(koz_boresight_B, at->v[1 + zone]) + bulge;
        if (!(half_angle <= 0.0f) && !(found <= shrunk - sinf(half_angle) * tolerance)) return 0;
    }
    return 1;
}

/* Bound on |dw/dt| / |w|^2 of torque-free motion. */
static float spread(void)
{
    return (largest_moment - smallest_moment) / (2.0f * smallest_moment);
}

static int is_safe(const koz_situation *now, const body_state *body, float margin)
{
    float momentum, fastest, error, length, piece, drift, straight, bulge, integration, turned, to_body[4];
    coast at;
    int zone, done;
    multiply(inertia, body->omega_BN_B, at.v[0]);
    koz_conjugate(body->q_BN, to_body);
    for (zone = 0; zone < KOZ_ZONES; zone++) koz_rotate(to_body, now->zone_axis_N[zone], at.v[1 + zone]);
    momentum = koz_norm(at.v[0]);
    fastest = momentum / smallest_moment;
    error = arc_error + fastest * KOZ_STEP_SECONDS * (fastest * KOZ_STEP_SECONDS);
    length = (1.0f + error) * momentum / (2.0f * brake_limit);
    piece = length / (float)SAMPLES;
    drift = fastest * error + 2.0f * rate_error;
    straight = fastest * length + 2.0f * rate_error * length;
    if (clear(now, &at, 0.0f, margin + straight)) return 1;
    turned = fastest * piece;
    bulge = (1.0f + spread()) * turned * turned / 8.0f;
    integration = (float)SAMPLES * turned * turned * turned * turned * turned / 120.0f;
    for (done = 0; done <= SAMPLES; done++) {
        if (!clear(now, &at, bulge, margin + drift * (float)done * piece + integration)) return 0;
        coast_on(&at, piece);
    }
    return 1;
}

/* Whether the boresight stays outside all zones during the step itself. */
static int step_is_clear(const koz_situation *now, const body_state *before, const body_state *after)
{
    const float thrust = @LARGEST_TORQUE@ / smallest_moment;
    float fastest = larger(koz_norm(before->omega_BN_B), koz_norm(after->omega_BN_B)) + thrust * KOZ_STEP_SECONDS;
    float bulge = ((1.0f + spread()) * fastest * fastest + thrust) * KOZ_STEP_SECONDS * KOZ_STEP_SECONDS / 8.0f;
    float start_N[3], end_N[3];
    int zone;
    koz_rotate(before->q_BN, koz_boresight_B, start_N);
    koz_rotate(after->q_BN, koz_boresight_B, end_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        const float *axis_N = now->zone_axis_N[zone];
        const float highest = larger(koz_dot(axis_N, start_N), koz_dot(axis_N, end_N));
        const float half_angle = now->zone_half_angle[zone];
        if (!(half_angle <= 0.0f) && !(highest + bulge <= cosf(half_angle))) return 0;
    }
    return 1;
}

/* Torque against the angular momentum as it stands in the middle of the step. */
static void brake(const body_state *body, float torque_B[3])
{
    float momentum_B[3], turned_B[3], size, strength;
    int i;
    multiply(inertia, body->omega_BN_B, momentum_B);
    koz_cross(momentum_B, body->omega_BN_B, turned_B);
    for (i = 0; i < 3; i++) momentum_B[i] += 0.5f * KOZ_STEP_SECONDS * turned_B[i];
    size = koz_norm(momentum_B);
    strength = smaller(brake_limit, size / KOZ_STEP_SECONDS);
    for (i = 0; i < 3; i++) torque_B[i] = size > 0.0f ? -strength * momentum_B[i] / size : 0.0f;
}

static int nearest_zone(const koz_situation *now, float *margin)
{
    float boresight_N[3], found;
    int zone, nearest = 0;
    koz_rotate(now->q_BN, koz_boresight_B, boresight_N);
    *margin = koz_angle(boresight_N, now->zone_axis_N[0]) - now->zone_half_angle[0];
    for (zone = 1; zone < KOZ_ZONES; zone++) {
        found = koz_angle(boresight_N, now->zone_axis_N[zone]) - now->zone_half_angle[zone];
        if (found < *margin) {
            *margin = found;
            nearest = zone;
        }
    }
    return nearest;
}

/* Torque that leads the boresight around the nearest zone, to the side that it moves or is pushed to already. */
static void guide(const koz_situation *now, const body_state *body, const float requested_B[3], float torque_B[3])
{
    const float *look_B = koz_boresight_B, *omega_B = body->omega_BN_B;
    float to_body[4], axis_B[3], inward_B[3], aside_B[3], momentum_B[3], gyroscopic_B[3], pushed_B[3], moved_B[3];
    float course_B[3], wanted_B[3], margin, along, size, drift, sideways, outward, largest;
    const int nearest = nearest_zone(now, &margin);
    int i;
    koz_conjugate(body->q_BN, to_body);
    koz_rotate(to_body, now->zone_axis_N[nearest], axis_B);
    along = koz_dot(axis_B, look_B);
    for (i = 0; i < 3; i++) inward_B[i] = axis_B[i] - along * look_B[i];
    size = koz_norm(inward_B);
    for (i = 0; i < 3; i++) inward_B[i] = size > 0.0f ? inward_B[i] / size : 0.0f;
    koz_cross(inward_B, look_B, aside_B);
    multiply(inertia, omega_B, momentum_B);
    koz_cross(omega_B, momentum_B, gyroscopic_B);
    for (i = 0; i < 3; i++) moved_B[i] = requested_B[i] - gyroscopic_B[i];
    multiply(inverse_inertia, moved_B, pushed_B);
    for (i = 0; i < 3; i++) pushed_B[i] += omega_B[i];
    koz_cross(pushed_B, look_B, moved_B);
    drift = koz_dot(aside_B, moved_B);
    sideways = drift >= 0.0f ? guide_rate : -guide_rate;
    outward = larger(-guide_rate, smaller(guide_rate, 2.0f * shield_margin - margin));
    for (i = 0; i < 3; i++) course_B[i] = sideways * aside_B[i] - outward * inward_B[i];
    koz_cross(look_B, course_B, wanted_B);
    for (i = 0; i < 3; i++) wanted_B[i] = (wanted_B[i] - omega_B[i]) / guide_seconds;
    multiply(inertia, wanted_B, torque_B);
    largest = 0.0f;
    for (i = 0; i < 3; i++) {
        torque_B[i] += gyroscopic_B[i];
        largest = larger(largest, fabsf(torque_B[i])@SHARE_OF_I@);
    }
    largest = larger(1.0f, largest@SHARE@);
    for (i = 0; i < 3; i++) torque_B[i] /= largest;
}

static void body_of(const koz_situation *now, body_state *body)
{
    int i;
    for (i = 0; i < 4; i++) body->q_BN[i] = now->q_BN[i];
    for (i = 0; i < 3; i++) body->omega_BN_B[i] = now->omega_BN_B[i];
}

int koz_is_safe(const koz_situation *now)
{
    body_state body;
    body_of(now, &body);
    return is_safe(now, &body, shield_margin);
}

void koz_shield(const koz_situation *now, const float requested_B[3], float allowed_B[3])
{
    const float margins[CANDIDATES] = {shield_margin, shield_margin, 0.5f * shield_margin};
    float candidates_B[CANDIDATES][3];
    body_state body, after;
    int i, tried;
    body_of(now, &body);
    for (i = 0; i < 3; i++)
        candidates_B[0][i] = larger(-@LIMIT_OF_I@, smaller(@LIMIT_OF_I@, requested_B[i]));
    guide(now, &body, candidates_B[0], candidates_B[2]);
    for (i = 0; i < 3; i++) candidates_B[1][i] = 0.5f * (candidates_B[0][i] + candidates_B[2][i]);
    for (tried = 0; tried < CANDIDATES; tried++) {
        push(&body, candidates_B[tried], &after);
        if (step_is_clear(now, &body, &after) && is_safe(now, &after, margins[tried])) {
            for (i = 0; i < 3; i++) allowed_B[i] = candidates_B[tried][i];
            return;
        }
    }
    brake(&body, allowed_B);
}
