/*
 * Self-test: golden vectors that koz_jax computed, and the time per decision.
 * make test, or: cc -std=c99 -O2 -o koz_selftest koz_policy.c koz_selftest.c -lm && ./koz_selftest
 *
@HEAD@
 */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "koz_policy.h"

#define COUNT @COUNT@
#define DECISIONS 20000
#define OBSERVATION_TOLERANCE @OBSERVATION_TOLERANCE@
#define ACTION_TOLERANCE @ACTION_TOLERANCE@

/* Attitudes are of either sign and do not follow each other. */
static const koz_situation situations[COUNT] = {
@SITUATIONS@
};

static const koz_memory memories[COUNT] = {
@MEMORIES@
};

static const float observations[COUNT][KOZ_OBSERVATION_SIZE] = {
@OBSERVATIONS@
};

static const float actions[COUNT][KOZ_ACTION_SIZE] = {
@ACTIONS@
};
@TORQUES@
@WHEELS@static const float wheel_torques[COUNT][KOZ_WHEELS] = {
@WHEELS@@WHEEL_TORQUE_ROWS@
@WHEELS@};
@WHEELS@
/* Largest difference so far; not a number counts as the largest. */
static double worse(double worst, float found, float expected)
{
    const double difference = fabs((double)found - (double)expected);
    return difference <= worst ? worst : difference;
}

int main(void)
{
    double observed = 0.0, decided = 0.0, applied = 0.0, seconds;
    float observation[KOZ_OBSERVATION_SIZE], action[KOZ_ACTION_SIZE], torque_B[KOZ_ACTION_SIZE], kept = 0.0f;
@WHEELS@    float wheel_torque[KOZ_WHEELS];
@WHEELS@    double turned = 0.0;
    koz_memory memory;
    clock_t start;
    int i, n, refused = 0, passed;
    for (n = 0; n < COUNT; n++) {
        refused += koz_fault(&situations[n]) != NULL;
        memory = memories[n];
        koz_observe(&memory, &situations[n], observation);
        for (i = 0; i < KOZ_OBSERVATION_SIZE; i++) observed = worse(observed, observation[i], observations[n][i]);
@MEMORY_CHECK@        koz_decide(observations[n], action);
        koz_torque(@MEMORY_ARGUMENT@observations[n], torque_B);
        for (i = 0; i < KOZ_ACTION_SIZE; i++) {
            decided = worse(decided, action[i], actions[n][i]);
            applied = worse(applied, torque_B[i], @EXPECTED_TORQUE@);
        }
@WHEELS@        koz_wheel_torques(&situations[n], torques[n], wheel_torque);
@WHEELS@        for (i = 0; i < KOZ_WHEELS; i++) turned = worse(turned, wheel_torque[i], wheel_torques[n][i]);
    }
    koz_start(&memory, &situations[0]);
    start = clock();
    for (n = 0; n < DECISIONS; n++) {
        koz_observe(&memory, &situations[n % COUNT], observation);
        koz_torque(@MEMORY_ARGUMENT@observation, torque_B);
@WHEELS@        koz_wheel_torques(&situations[n % COUNT], torque_B, wheel_torque);
        kept += torque_B[0];
    }
    seconds = (double)(clock() - start) / (double)CLOCKS_PER_SEC;
    passed = observed <= OBSERVATION_TOLERANCE && decided <= ACTION_TOLERANCE
        && applied <= (double)@LARGEST_LIMIT@ * ACTION_TOLERANCE && refused == 0
@WHEELS@        && turned <= (double)@LARGEST_WHEEL_TORQUE@ * ACTION_TOLERANCE
        && fabsf(kept) <= (float)DECISIONS * @LARGEST_LIMIT@;
    printf("golden vectors: %d\n", COUNT);
    printf("largest difference of an observation: %.2e (tolerance %.0e)\n", observed, OBSERVATION_TOLERANCE);
    printf("largest difference of an action: %.2e (tolerance %.0e)\n", decided, ACTION_TOLERANCE);
@WHEELS@    printf("largest difference of a wheel's torque: %.2e N m\n", turned);
    printf("time per decision: %.2f us\n", 1e6 * seconds / DECISIONS);
    printf("%s\n", passed ? "passed" : "FAILED");
    return passed ? 0 : 1;
}
