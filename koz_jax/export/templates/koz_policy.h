/*
@HEAD@
 */
#ifndef KOZ_POLICY_H
#define KOZ_POLICY_H

#define KOZ_OBSERVATION_SIZE @OBSERVATION_SIZE@
#define KOZ_ZONES @ZONES@ /* zones to be told of */
#define KOZ_OBSERVED_ZONES @OBSERVED_ZONES@ /* of which the policy sees the nearest */
@WHEELS@#define KOZ_WHEELS @WHEEL_COUNT@
@SEVERAL@#define KOZ_INSTRUMENTS @INSTRUMENTS@ /* that zones are for */
#define KOZ_ACTION_SIZE @ACTION_SIZE@
#define @LIMIT_DEFINITION@
#define KOZ_STEP_SECONDS @STEP_SECONDS@ /* [s] between decisions; the torque is held in between */
@URGENCY_DEFINITION@#define KOZ_CONFIG_SHA256 "@CONFIG_SHA256@" /* config.json of the training run */
#define KOZ_TRAINING_SHA256 "@TRAINING_SHA256@" /* network, task and origin */
#define KOZ_WEIGHTS_SHA256 "@WEIGHTS_SHA256@"
#define KOZ_EXPORT_ID @EXPORT_ID@

#ifdef __cplusplus
extern "C" {
#endif

/*
 * What the controller must be told, as koz_fault checks.  Of a quaternion and a unit vector only the direction counts,
 * not the length, and q and -q are the same attitude.
 */
typedef struct {
    float q_BN[4];       /* attitude, body relative to inertial; scalar first, of either sign */
    float omega_BN_B[3]; /* [rad/s] rate of the body relative to inertial, in body axes */
    float q_DN[4];       /* target attitude; of either sign, the same one from koz_start on */
    float zone_axis_N[KOZ_ZONES][3];  /* unit vectors to the bright objects, in inertial axes */
    float zone_half_angle[KOZ_ZONES]; /* [rad]; -pi where there is no zone */
@WHEELS@    float wheel_momentum[KOZ_WHEELS]; /* [N m s] of each wheel about its axis */
@SEVERAL@    int zone_instrument[KOZ_ZONES];   /* number of the instrument that the zone is for, from 0 */
} koz_situation;

/* What the controller keeps from one step to the next. */
typedef struct {
    float q_e[4]; /* attitude error of the last step, its sign continuous in time */
@MEMORY_FIELD@} koz_memory;

/* NULL where a situation can be used, else which of its fields cannot be, and why. */
const char *koz_fault(const koz_situation *now);

/* Begin a maneuver, before its first koz_observe: q_e is taken with q_e0 >= 0, which is the shorter way. */
void koz_start(koz_memory *memory, const koz_situation *now);

/* The observation, as defined above; once in a time step.  Of q_e and -q_e it takes the one nearer to the last one. */
void koz_observe(koz_memory *memory, const koz_situation *now, float observation[KOZ_OBSERVATION_SIZE]);

/* The policy: action in [-1, 1]. */
void koz_decide(const float observation[KOZ_OBSERVATION_SIZE], float action[KOZ_ACTION_SIZE]);

/* Torque in body axes [N m], to be held for KOZ_STEP_SECONDS; zero where an observation is not finite. */
@REMEMBERS@/* It needs the memory as the koz_observe left it that made the observation. */
@FORGETS@void koz_torque(const float observation[KOZ_OBSERVATION_SIZE], float torque_B[KOZ_ACTION_SIZE]);
@REMEMBERS@void koz_torque(const koz_memory *memory, const float observation[KOZ_OBSERVATION_SIZE],
@REMEMBERS@    float torque_B[KOZ_ACTION_SIZE]);
@WHEELS@
@WHEELS@/*
@WHEELS@ * What each wheel has to do for torque_B: the torque [N m] that it gives the body for KOZ_STEP_SECONDS, by which its own
@WHEELS@ * momentum falls.  They add what their momentum takes while the body turns; where one of them is at the end of its
@WHEELS@ * torque or of its momentum, all give less.  Zero where koz_fault finds a fault.
@WHEELS@ */
@WHEELS@void koz_wheel_torques(const koz_situation *now, const float torque_B[3], float wheel_torque[KOZ_WHEELS]);

#ifdef __cplusplus
}
#endif

#endif
