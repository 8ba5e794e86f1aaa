/*
 * Self-test of the shield: golden vectors that koz_jax computed, none within rounding of a threshold; time per decision.
 * make test, or: cc -std=c99 -O2 -o test koz_policy.c koz_shield.c koz_shield_selftest.c -lm && ./test
 *
@HEAD@
 */
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "koz_shield.h"

#define COUNT @COUNT@
#define DECISIONS 2000
#define TOLERANCE @TOLERANCE@ /* of the torque limit */

static const koz_situation situations[COUNT] = {
@SITUATIONS@
};

static const float requested[COUNT][3] = {
@REQUESTED@
};

static const float allowed[COUNT][3] = {
@ALLOWED@
};

static const int safe[COUNT] = {@SAFE@};

int main(void)
{
    double worst = 0.0, seconds;
    float torque_B[3], kept = 0.0f;
    clock_t start;
    int i, n, misjudged = 0, passed;
    for (n = 0; n < COUNT; n++) {
        koz_shield(&situations[n], requested[n], torque_B);
        for (i = 0; i < 3; i++) {
            const double difference = fabs((double)torque_B[i] - (double)allowed[n][i]) / (double)@LIMIT_OF_I@;
            worst = difference <= worst ? worst : difference; /* not a number counts as the largest */
        }
        misjudged += koz_is_safe(&situations[n]) != safe[n];
    }
    start = clock();
    for (n = 0; n < DECISIONS; n++) {
        koz_shield(&situations[n % COUNT], requested[n % COUNT], torque_B);
        kept += torque_B[0];
    }
    seconds = (double)(clock() - start) / (double)CLOCKS_PER_SEC;
    passed = worst <= TOLERANCE && misjudged == 0 && fabsf(kept) <= (float)DECISIONS * @LARGEST_LIMIT@;
    printf("golden vectors of the shield: %d\n", COUNT);
    printf("largest difference of a torque: %.2e of the limit (tolerance %.0e)\n", worst, TOLERANCE);
    printf("misjudged situations: %d\n", misjudged);
    printf("time per decision of the shield: %.2f us\n", 1e6 * seconds / DECISIONS);
    printf("%s\n", passed ? "passed" : "FAILED");
    return passed ? 0 : 1;
}
