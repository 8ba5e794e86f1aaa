/*
@HEAD@
 */
#ifndef KOZ_POLICY_H
#define KOZ_POLICY_H

#define KOZ_OBSERVATION_SIZE @OBSERVATION_SIZE@
#define KOZ_ZONES @ZONES@ /* zones to be told of */
#define KOZ_OBSERVED_ZONES @OBSERVED_ZONES@ /* of which the policy sees the nearest */
#define KOZ_ACTION_SIZE @ACTION_SIZE@
#define @LIMIT_DEFINITION@
#define KOZ_STEP_SECONDS @STEP_SECONDS@ /* [s] between decisions; the torque is held in between */
#define KOZ_CONFIG_SHA256 "@CONFIG_SHA256@" /* config.json of the training run */
#define KOZ_TRAINING_SHA256 "@TRAINING_SHA256@" /* network, task and origin */
#define KOZ_WEIGHTS_SHA256 "@WEIGHTS_SHA256@"
#define KOZ_EXPORT_ID @EXPORT_ID@

/* What the controller must be told.  All numbers must be finite, quaternions and axes of unit length. */
typedef struct {
    float q_BN[4];       /* attitude, body relative to inertial; scalar first, continuous in time (no jump to -q) */
    float omega_BN_B[3]; /* [rad/s] rate of the body relative to inertial, in body axes */
    float q_DN[4];       /* target attitude; of q_DN and -q_DN, the one for which q_e0 >= 0 at the start */
    float zone_axis_N[KOZ_ZONES][3];  /* unit vectors to the bright objects, in inertial axes */
    float zone_half_angle[KOZ_ZONES]; /* [rad]; -pi where there is no zone */
    float q_e0_previous; /* observation[0] of the step before; at the start, of this step: see koz_start */
} koz_situation;

/* Scalar part of the attitude error: q_e0_previous of the first step. */
float koz_start(const koz_situation *now);

/* The observation, as defined above. */
void koz_observe(const koz_situation *now, float observation[KOZ_OBSERVATION_SIZE]);

/* The policy: action in [-1, 1]. */
void koz_decide(const float observation[KOZ_OBSERVATION_SIZE], float action[KOZ_ACTION_SIZE]);

/* Torque in body axes [N m], to be held for KOZ_STEP_SECONDS. */
void koz_torque(const float observation[KOZ_OBSERVATION_SIZE], float torque_B[KOZ_ACTION_SIZE]);

#endif
