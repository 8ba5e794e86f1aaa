/*
 * Shield: lets a torque through only if the spacecraft can still come to rest outside all zones afterwards.
 * Keeps @MARGIN_DEG@ deg from every zone.  Made for errors of up to
 *     @STATED_INERTIA_ERROR@ of the inertia about any axis,
 *     @STATED_DISTURBANCE_TORQUE@ N m of constant torque from outside,
 *     @STATED_ATTITUDE_NOISE_DEG@ deg per axis in the measured attitude (standard deviation, cut at three times that),
 *     @STATED_RATE_NOISE_DEG@ deg/s per axis in the measured rate (likewise),
 *     @STATED_ATTITUDE_BIAS_DEG@ deg and @STATED_RATE_BIAS_DEG@ deg/s of constant error in what is measured.
 * Keeps the body rate below @MAX_RATE_DEG@.
 * Axes of zones may turn by up to @CONE_RATE_DEG@ deg/s; tell it of zones where they are.
 * Leads around a zone at @GUIDE_RATE_DEG@ deg/s, and looks at @SAMPLES@ points of a brake path.
 *
@HEAD@
 */
#ifndef KOZ_SHIELD_H
#define KOZ_SHIELD_H

#include "koz_policy.h"

#ifdef __cplusplus
extern "C" {
#endif

/*
 * The torque [N m] to apply for KOZ_STEP_SECONDS in place of the requested one, of koz_torque or of anything else.
 * Uses attitude, rate and zones of the situation.  From states on that koz_is_safe accepts, the boresight stays out of
 * every zone, as long as errors are no larger than those above and the torque allowed here is the one applied.
@WHEELS@ * Wheels can always brake up to the rate that it lets the body turn at, which depends on their momentum.
 * From others it leads out and away.  Zero where koz_fault finds one.  requested_B and allowed_B may be the same.
 */
void koz_shield(const koz_situation *now, const float requested_B[3], float allowed_B[3]);

@NO_WHEELS@/* Whether braking from here keeps the boresight outside all zones, with the margin. */
@WHEELS@/* Whether wheels can brake from here, and that keeps the boresight outside all zones, with the margin. */
int koz_is_safe(const koz_situation *now);

#ifdef __cplusplus
}
#endif

#endif
