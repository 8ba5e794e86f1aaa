/*
 * See koz_shield.h.  A candidate passes if braking after it keeps the margin; the first one that passes is the torque:
 * the request, a guide away from the zone where there is too little, mixes of the request with a guide around the zone,
 * mixes of that guide with the brake.
 *
@HEAD@
 */
#include "koz_shield.h"

#include <stddef.h>

#include "koz_math.h"
@WHEELS@#include "koz_wheels.h"

#if KOZ_EXPORT_ID != @EXPORT_ID@
#error "this shield and koz_policy.h are of different exports"
#endif

#define SAMPLES @SAMPLES@
#define REQUEST_SHARES @REQUEST_SHARES_COUNT@
#define GUIDE_SHARES @GUIDE_SHARES_COUNT@

static const float inertia[3][3] = {@INERTIA@};
static const float inverse_inertia[3][3] = {@INVERSE_INERTIA@};
static const float smallest_moment = @SMALLEST_MOMENT@; /* [kg m^2] of inertia */
static const float largest_moment = @LARGEST_MOMENT@;
static const float speed_per_momentum@OF_INSTRUMENTS@ = @SPEED_PER_MOMENTUM@; /* [1/(kg m^2)] largest, of the boresight */
static const float shield_margin = @MARGIN@; /* [rad] kept from every zone */
static const float brake_limit = @BRAKE_TORQUE@; /* [N m] norm of the torque that brakes whatever disturbs */
static const float attitude_error = @ATTITUDE_ERROR@; /* [rad] largest, of what is measured */
static const float rate_error = @RATE_ERROR@; /* [rad/s] */
static const float cone_rate = @CONE_RATE@; /* [rad/s] largest, of a zone's axis */
static const float approach = @APPROACH@; /* [rad/s] with which a zone may come closer while the craft is held */
static const float soon = @SOON@; /* [s] in which the guide leads away from it */
static const float guide_margin = @GUIDE_MARGIN@; /* [rad] that the guide keeps */
static const float guide_rate = @GUIDE_RATE@; /* [rad/s] around a zone */
static const float guide_seconds = @GUIDE_SECONDS@; /* [s] in which the guide takes up its rate */
static const float guide_tilt = @GUIDE_TILT@; /* of the way around, away from the zone */
static const float guide_ahead = @GUIDE_AHEAD@; /* times guide_seconds */
static const float slow_steps = @SLOW_STEPS@; /* of the brake, from a state that is as good as at rest */
static const float least_gain = @RAISE@; /* [rad] of clearance */
static const float request_shares[REQUEST_SHARES] = {@REQUEST_SHARES@};
static const float guide_shares[GUIDE_SHARES] = {@GUIDE_SHARES@};
static const float rate_form[3][3] = {@RATE_FORM@}; /* w.M w: squared largest rate of free motion; 0: no limit */
@NO_WHEELS@static const float squared_rate = @SQUARED_RATE@; /* [(rad/s)^2] its limit */
@WHEELS@static const float rate_reserve = @RATE_RESERVE@; /* [rad/s] by which that of the wheels is tighter */
static const float rate_rounding = @RATE_ROUNDING@;
static const float unbounded = 1e9f; /* [rad] more than any margin */

typedef struct {
    float q_BN[4];
    float omega_BN_B[3];
} body_state;

/* What a torque does not do as it should. */
typedef struct {
    float inertia;     /* relative error */
    float disturbance; /* [N m] */
    float later;       /* [rad/s] with which a zone comes closer after the time in which it is led away from */
} errors;

static const errors stated = {@INERTIA_ERROR@, @DISTURBANCE@, @APPROACH@};
static const errors none = {0.0f, 0.0f, 0.0f};

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

/* Margin [rad] to a zone where the boresight has this cosine to its axis. */
static float margin_at(const koz_situation *now, int zone, float cosine)
{
    const float half_angle = now->zone_half_angle[zone];
    return half_angle > 0.0f ? acosf(larger(-1.0f, smaller(1.0f, cosine))) - half_angle : unbounded;
}

/* Bound on the second derivative of the boresight in free motion. */
@ONE@static float bend(float momentum, float rate)
@SEVERAL@static float bend(const koz_situation *now, int zone, float momentum, float rate)
{
    const float speed = speed_per_momentum@OF_ZONE@ * momentum;
    return rate * (speed + smaller(speed, rate));
}

static float twice_energy(const body_state *body, float *momentum)
{
    float momentum_B[3];
    multiply(inertia, body->omega_BN_B, momentum_B);
    *momentum = koz_norm(momentum_B);
    return larger(koz_dot(body->omega_BN_B, momentum_B), 0.0f);
}

/* Seconds of torque-free motion that the brake runs through: whole steps, the last one with what is left. */
static float free_seconds(float momentum)
{
    const float whole = brake_limit * KOZ_STEP_SECONDS;
    const float rest = momentum - whole * floorf(momentum / whole);
    const float steps = (momentum * momentum - rest * rest) / (2.0f * brake_limit);
    return momentum > 0.0f ? (steps + 0.5f * rest * KOZ_STEP_SECONDS) / momentum : 0.5f * KOZ_STEP_SECONDS;
}

/* How far the true brake path may be from the computed one. */
typedef struct {
    float at_rest;     /* [rad] at its end, of what grows with the square of the time */
    float gyroscopic;  /* [rad] at its end, of a wrong inertia's gyroscopic torque */
    float drift;       /* [rad/s] per second of free motion */
    float integration; /* [rad] */
    float soon;        /* [rad] that zones come closer in some time */
    float swept;       /* [rad] that they come closer in the rest of the brake's time */
} tolerance;

/* Error of the angular acceleration without a torque, per squared rate. */
static float gyroscopic_error(const errors *doubt)
{
    const float e = doubt->inertia, trust = e / (1.0f - e);
    const float spread = (largest_moment - smallest_moment) + e * (largest_moment + smallest_moment);
    return e * sqrtf(largest_moment / smallest_moment) + trust * spread / (2.0f * smallest_moment);
}

static tolerance tolerance_of(const errors *doubt, float momentum, float rate, float length, float push_error)
{
    const float trust = doubt->inertia / (1.0f - doubt->inertia);
    const float arc = rate * length, piece = arc / (float)SAMPLES, turned = rate * KOZ_STEP_SECONDS;
    const float astray = trust + turned * turned;
    tolerance found;
    found.at_rest = arc * astray * (1.0f + astray) + trust * turned;
    found.at_rest += 2.0f * doubt->disturbance * length * length / smallest_moment;
    found.gyroscopic = gyroscopic_error(doubt) * arc * arc;
    found.drift = 2.0f * push_error;
    found.integration = (float)SAMPLES * piece * piece * piece * piece * piece / 120.0f;
    found.soon = approach * soon;
    found.swept = doubt->later * larger(momentum / brake_limit - (soon - 2.0f * KOZ_STEP_SECONDS), 0.0f);
    return found;
}

static float tolerated(const tolerance *bound, float share, float seconds)
{
    const float time = 1.0f - sqrtf(larger(1.0f - share, 0.0f));
    return bound->at_rest * time * time + bound->gyroscopic * (2.0f * time * time - time * time * time * time)
        + bound->drift * seconds + bound->integration + bound->soon + bound->swept * time;
}

/*
 * Lower bound of the margin [rad] to all zones on the brake path from here.  A bound of at least shield_margin need not
 * be the best; one below least is returned as it stands.
 */
static float clearance(
    const errors *doubt, const koz_situation *now, const body_state *body, float push_error, float least)
{
    float momentum, rate, speed, length, piece, bulge, to_body[4], look_N[3], found, lowest = unbounded;
    tolerance bound;
    coast at;
    int zone, done;
    rate = sqrtf(twice_energy(body, &momentum) / smallest_moment);
@ONE@    speed = smaller(speed_per_momentum * momentum, rate);
    length = free_seconds(momentum);
    piece = length / (float)SAMPLES;
    bound = tolerance_of(doubt, momentum, rate, length, push_error);
@ONE@    koz_rotate(body->q_BN, koz_boresight_B, look_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        if (now->zone_half_angle[zone] <= 0.0f) continue;
@SEVERAL@        speed = smaller(speed_per_momentum@OF_ZONE@ * momentum, rate);
@SEVERAL@        koz_rotate(body->q_BN, koz_boresight_B@OF_ZONE@, look_N);
        found = koz_angle(look_N, now->zone_axis_N[zone]) - now->zone_half_angle[zone];
        lowest = smaller(lowest, found - speed * length - tolerated(&bound, 1.0f, length));
    }
    if (lowest >= shield_margin) return lowest;
    multiply(inertia, body->omega_BN_B, at.v[0]);
    koz_conjugate(body->q_BN, to_body);
    for (zone = 0; zone < KOZ_ZONES; zone++) koz_rotate(to_body, now->zone_axis_N[zone], at.v[1 + zone]);
@ONE@    bulge = bend(momentum, rate) * piece * piece / 8.0f;
    lowest = unbounded;
    for (done = 0; done <= SAMPLES && lowest >= least; done++) {
        const float off = tolerated(&bound, (float)done / (float)SAMPLES, (float)done * piece);
        if (done > 0) coast_on(&at, piece);
@ONE@        for (zone = 0; zone < KOZ_ZONES; zone++)
@ONE@            lowest = smaller(lowest, margin_at(now, zone, koz_dot(koz_boresight_B, at.v[1 + zone]) + bulge) - off);
@SEVERAL@        for (zone = 0; zone < KOZ_ZONES; zone++) {
@SEVERAL@            found = koz_dot(koz_boresight_B@OF_ZONE@, at.v[1 + zone]);
@SEVERAL@            bulge = bend(now, zone, momentum, rate) * piece * piece / 8.0f;
@SEVERAL@            lowest = smaller(lowest, margin_at(now, zone, found + bulge) - off);
@SEVERAL@        }
    }
    return lowest;
}

/* Lower bound of the margin [rad] to all zones during the step itself. */
static float step_clearance(
    const koz_situation *now, const body_state *before, const body_state *after, const float torque_B[3])
{
    const float dt = KOZ_STEP_SECONDS, size = koz_norm(torque_B) + stated.disturbance;
    float momentum, momentum_after, energy, rate, bulge, start_N[3], end_N[3], lowest = unbounded;
    int zone;
    energy = twice_energy(before, &momentum);
    energy = larger(energy, twice_energy(after, &momentum_after));
    momentum = larger(momentum, momentum_after) + 0.5f * size * dt;
    rate = sqrtf(energy / smallest_moment) + size * dt / (2.0f * smallest_moment);
@ONE@    bulge = (bend(momentum, rate) + speed_per_momentum * size) * dt * dt / 8.0f;
@ONE@    koz_rotate(before->q_BN, koz_boresight_B, start_N);
@ONE@    koz_rotate(after->q_BN, koz_boresight_B, end_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        const float *axis_N = now->zone_axis_N[zone];
@SEVERAL@        bulge = bend(now, zone, momentum, rate) + speed_per_momentum@OF_ZONE@ * size;
@SEVERAL@        bulge *= dt * dt / 8.0f;
@SEVERAL@        koz_rotate(before->q_BN, koz_boresight_B@OF_ZONE@, start_N);
@SEVERAL@        koz_rotate(after->q_BN, koz_boresight_B@OF_ZONE@, end_N);
        lowest = smaller(
            lowest, margin_at(now, zone, larger(koz_dot(axis_N, start_N), koz_dot(axis_N, end_N)) + bulge));
    }
    return lowest - cone_rate * dt;
}

/* Torque against the angular momentum as it stands in the middle of the step. */
static void brake(const body_state *body, float torque_B[3])
{
    float momentum_B[3], turned_B[3], size, strength;
    int i;
    multiply(inertia, body->omega_BN_B, momentum_B);
    strength = smaller(brake_limit + stated.disturbance, koz_norm(momentum_B) / KOZ_STEP_SECONDS);
    koz_cross(momentum_B, body->omega_BN_B, turned_B);
    for (i = 0; i < 3; i++) momentum_B[i] += 0.5f * KOZ_STEP_SECONDS * turned_B[i];
    size = koz_norm(momentum_B);
    for (i = 0; i < 3; i++) torque_B[i] = size > 0.0f ? -strength * momentum_B[i] / size : 0.0f;
}

/* Torque within the box that takes up a rate. */
@NO_WHEELS@static void take_up(const body_state *body, const float rate_B[3], float torque_B[3])
@WHEELS@static void take_up(const body_state *body, const float limit_B[3], const float rate_B[3], float torque_B[3])
{
    float wanted_B[3], momentum_B[3], gyroscopic_B[3], largest = 0.0f;
    int i;
    for (i = 0; i < 3; i++) wanted_B[i] = (rate_B[i] - body->omega_BN_B[i]) / guide_seconds;
    multiply(inertia, wanted_B, torque_B);
    multiply(inertia, body->omega_BN_B, momentum_B);
    koz_cross(body->omega_BN_B, momentum_B, gyroscopic_B);
    for (i = 0; i < 3; i++) {
        torque_B[i] += gyroscopic_B[i];
        largest = larger(largest, fabsf(torque_B[i]) / @NOW_LIMIT_OF_I@);
    }
    largest = larger(1.0f, largest);
    for (i = 0; i < 3; i++) torque_B[i] /= largest;
}

/* Rate [rad/s] that leads away from a zone at this margin [rad]. */
static float rate_away(float margin)
{
    const float missing = (2.0f * guide_margin - margin) / (guide_ahead * guide_seconds);
    return larger(0.0f, smaller(guide_rate, missing));
}

/*
 * Torques that lead the boresight around the nearest zone and away from all near ones, and only away.  Returns the
 * margin [rad] to the nearest.
 */
static float guide(
    const koz_situation *now, const body_state *body, const float requested_B[3], float around_B[3], float away_B[3])
{
    float to_body[4], axis_B[3], look_N[3], out_B[3], nearest_B[3] = {0.0f, 0.0f, 0.0f}, side_B[3], rate_B[3];
    float momentum_B[3], gyroscopic_B[3], pushed_B[3], soon_B[3], missing_B[3] = {0.0f, 0.0f, 0.0f};
@WHEELS@    float limit_B[3];
    float margin, size, missing, taken, sideways, nearest = unbounded;
@SEVERAL@    const float *look_B = koz_boresight_B[0]; /* that of the nearest zone */
    int zone, i;
    koz_conjugate(body->q_BN, to_body);
@ONE@    koz_rotate(body->q_BN, koz_boresight_B, look_N);
    for (zone = 0; zone < KOZ_ZONES; zone++) {
        if (now->zone_half_angle[zone] <= 0.0f) continue;
@SEVERAL@        koz_rotate(body->q_BN, koz_boresight_B@OF_ZONE@, look_N);
        margin = koz_angle(look_N, now->zone_axis_N[zone]) - now->zone_half_angle[zone];
        koz_rotate(to_body, now->zone_axis_N[zone], axis_B);
        koz_cross(axis_B, koz_boresight_B@OF_ZONE@, out_B);
        size = koz_norm(out_B);
        missing = rate_away(margin);
        for (i = 0; i < 3; i++) {
            out_B[i] = size > 0.0f ? out_B[i] / size : 0.0f;
            missing_B[i] += missing * out_B[i];
            if (margin < nearest) nearest_B[i] = out_B[i];
        }
@SEVERAL@        if (margin < nearest) look_B = koz_boresight_B@OF_ZONE@;
        nearest = smaller(nearest, margin);
    }
    /* What leads away from other zones does not take from what leads away from the nearest. */
    taken = larger(0.0f, rate_away(nearest) - koz_dot(missing_B, nearest_B));
    for (i = 0; i < 3; i++) missing_B[i] += taken * nearest_B[i];
@ONE@    koz_cross(nearest_B, koz_boresight_B, side_B);
@SEVERAL@    koz_cross(nearest_B, look_B, side_B);
    multiply(inertia, body->omega_BN_B, momentum_B);
    koz_cross(body->omega_BN_B, momentum_B, gyroscopic_B);
    for (i = 0; i < 3; i++) pushed_B[i] = requested_B[i] - gyroscopic_B[i];
    multiply(inverse_inertia, pushed_B, soon_B);
    for (i = 0; i < 3; i++) soon_B[i] = body->omega_BN_B[i] + guide_ahead * guide_seconds * soon_B[i];
    sideways = koz_dot(soon_B, side_B) >= 0.0f ? guide_rate : -guide_rate;
    for (i = 0; i < 3; i++) rate_B[i] = sideways * side_B[i] + guide_tilt * guide_rate * nearest_B[i] + missing_B[i];
@WHEELS@    koz_wheels_limits(now, limit_B);
    take_up(body, @LIMIT_ARGUMENT@rate_B, around_B);
    take_up(body, @LIMIT_ARGUMENT@missing_B, away_B);
    return nearest;
}

static body_state body_of(const koz_situation *now)
{
    body_state body;
    int i;
    for (i = 0; i < 4; i++) body.q_BN[i] = now->q_BN[i];
    for (i = 0; i < 3; i++) body.omega_BN_B[i] = now->omega_BN_B[i];
    return body;
}

@WHEELS@/* Square of the rate [rad/s] that the wheels can stop, by the momentum that is on board. */
@WHEELS@static float squared_limit(const koz_situation *now)
@WHEELS@{
@WHEELS@    const float rate = larger(koz_wheels_largest_rate(now) - rate_reserve, 0.0f);
@WHEELS@    return rate * rate;
@WHEELS@}
@WHEELS@
@WHEELS@static float squared_peak(const float omega_B[3]);
@WHEELS@
int koz_is_safe(const koz_situation *now)
{
    const koz_situation unit = koz_unit_situation(now);
    const body_state body = body_of(&unit);
    if (2.0f * approach > guide_rate) return 0;
@WHEELS@    if (!(squared_peak(body.omega_BN_B) <= squared_limit(&unit))) return 0;
@WHEELS@    if (!(squared_limit(&unit) >= 8.0f * approach * approach)) return 0;
    return koz_fault(now) == NULL && clearance(&stated, &unit, &body, 0.0f, shield_margin) >= shield_margin;
}

typedef struct {
    const koz_situation *now;
    body_state body;
    float present; /* [rad] clearance of braking, where what is no worse will do; else unbounded */
@WHEELS@    float squared_rate; /* [(rad/s)^2] limit of what rate_form gives */
} search;

/* Lower bound of the clearance [rad] after a candidate; one below least is returned as it stands. */
static float clearance_after(
    const errors *doubt, const search *at, const float torque_B[3], const body_state *after, float least)
{
    const float trust = doubt->inertia / (1.0f - doubt->inertia), size = koz_norm(torque_B);
    float momentum, rate, pushed;
    rate = sqrtf(twice_energy(&at->body, &momentum) / smallest_moment);
    rate += (size + doubt->disturbance) * KOZ_STEP_SECONDS / smallest_moment;
    pushed = (trust * size / smallest_moment + gyroscopic_error(doubt) * rate * rate) * KOZ_STEP_SECONDS;
    return clearance(doubt, at->now, after, pushed, least);
}

/* Square of the largest rate that the body has if it coasts or brakes from here. */
static float squared_peak(const float omega_B[3])
{
    float slope_B[3];
    multiply(rate_form, omega_B, slope_B);
    return koz_dot(omega_B, slope_B);
}

/* Mix a torque with the brake's, as far as the rate limit needs it. */
@NO_WHEELS@static void limit_rate(const body_state *body, const float brake_B[3], float torque_B[3])
@WHEELS@static void limit_rate(const body_state *body, float squared_rate, const float brake_B[3], float torque_B[3])
{
    body_state asked, braked;
    float change_B[3], slope_B[3], least, room, square, half, root, share;
    int i;
    push(body, torque_B, &asked);
    push(body, brake_B, &braked);
    least = squared_peak(braked.omega_BN_B);
    if (squared_peak(asked.omega_BN_B) <= larger(squared_rate, least)) return;
    for (i = 0; i < 3; i++) change_B[i] = asked.omega_BN_B[i] - braked.omega_BN_B[i];
    multiply(rate_form, change_B, slope_B);
    room = larger(squared_rate - least, 0.0f);
    square = koz_dot(change_B, slope_B);
    half = koz_dot(braked.omega_BN_B, slope_B);
    root = sqrtf(half * half + square * room);
    if (half > 0.0f)
        share = room / (half + root);
    else
        share = square > 0.0f ? (root - half) / square : 1.0f;
    share = smaller(share, 1.0f);
    for (i = 0; i < 3; i++) torque_B[i] = brake_B[i] + share * (torque_B[i] - brake_B[i]);
}

/* Whether a torque can be let through. */
static int is_allowed(const errors *doubt, const search *at, const float torque_B[3], float least)
{
    const float slack = attitude_error + rate_error * KOZ_STEP_SECONDS;
@WHEELS@    const float squared_rate = at->squared_rate;
    body_state after;
    float least_peak;
    push(&at->body, torque_B, &after);
    least_peak = larger(squared_rate, squared_peak(at->body.omega_BN_B));
    if (!(squared_peak(after.omega_BN_B) <= (1.0f + rate_rounding) * least_peak)) return 0;
    if (!(clearance_after(doubt, at, torque_B, &after, least) >= least)) return 0;
    return at->present <= slack || step_clearance(at->now, &at->body, &after, torque_B) >= slack;
}

/* Whether a share + b (1 - share) can be let through, which it then is: allowed_B. */
static int passes(
    const search *at, float share, const float a_B[3], const float b_B[3], float least, float allowed_B[3])
{
    int i;
    for (i = 0; i < 3; i++) allowed_B[i] = share * a_B[i] + (1.0f - share) * b_B[i];
    return is_allowed(&stated, at, allowed_B, least);
}

static void allow(const koz_situation *now, const float requested_B[3], float allowed_B[3])
{
    search at;
    body_state after;
@WHEELS@    float limit_B[3];
    float request_B[3], around_B[3], away_B[3], brake_B[3], momentum, braking, nearest, present, least;
    int i;
    at.now = now;
    at.body = body_of(now);
    at.present = unbounded;
@WHEELS@    at.squared_rate = squared_limit(now);
@WHEELS@    koz_wheels_limits(now, limit_B);
    for (i = 0; i < 3; i++) request_B[i] = larger(-@NOW_LIMIT_OF_I@, smaller(@NOW_LIMIT_OF_I@, requested_B[i]));
    brake(&at.body, brake_B);
    if (!isfinite(requested_B[0]) || !isfinite(requested_B[1]) || !isfinite(requested_B[2]))
        for (i = 0; i < 3; i++) request_B[i] = brake_B[i];
    limit_rate(&at.body, @RATE_ARGUMENT@brake_B, request_B);
    if (passes(&at, 1.0f, request_B, request_B, shield_margin, allowed_B)) return;

    nearest = guide(now, &at.body, request_B, around_B, away_B);
    push(&at.body, brake_B, &after);
    /* Braking and fleeing are compared as they are meant. */
    braking = clearance_after(&none, &at, brake_B, &after, -unbounded);
    (void)twice_energy(&at.body, &momentum);
    /* Of a slow state the clearance is known well, and what is no worse will do; inside a zone any way out is good. */
    if (momentum <= slow_steps * brake_limit * KOZ_STEP_SECONDS || nearest <= 0.0f) at.present = braking;
    present = at.present;
    /* Straight away from a zone that comes is good at any speed. */
    if (approach > 0.0f) at.present = braking;
    least = smaller(0.5f * shield_margin, at.present);
    if (braking < 0.5f * shield_margin && is_allowed(&none, &at, away_B, least)) {
        for (i = 0; i < 3; i++) allowed_B[i] = away_B[i];
        return;
    }
    at.present = present;
    least = smaller(shield_margin, at.present + least_gain);
    for (i = 0; i < REQUEST_SHARES; i++)
        if (passes(&at, request_shares[i], request_B, around_B, least, allowed_B)) return;
    least = smaller(0.5f * shield_margin, at.present);
    for (i = 0; i < GUIDE_SHARES; i++)
        if (passes(&at, guide_shares[i], around_B, brake_B, least, allowed_B)) return;
    for (i = 0; i < 3; i++) allowed_B[i] = brake_B[i];
}

void koz_shield(const koz_situation *now, const float requested_B[3], float allowed_B[3])
{
    const koz_situation unit = koz_unit_situation(now);
    float found_B[3] = {0.0f, 0.0f, 0.0f};
@WHEELS@    float limit_B[3];
    int i;
    if (koz_fault(now) == NULL) allow(&unit, requested_B, found_B);
@WHEELS@    koz_wheels_limits(&unit, limit_B);
    /* No more than there is, not by rounding either. */
    for (i = 0; i < 3; i++) allowed_B[i] = larger(-@NOW_LIMIT_OF_I@, smaller(@NOW_LIMIT_OF_I@, found_B[i]));
}
