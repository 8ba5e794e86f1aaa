/*
 * Shield: lets a torque through only if the spacecraft can still come to rest outside all zones afterwards.
 * Keeps @MARGIN_DEG@ deg from every zone.
 *
@HEAD@
 */
#ifndef KOZ_SHIELD_H
#define KOZ_SHIELD_H

#include "koz_policy.h"

/*
 * The torque [N m] to apply for KOZ_STEP_SECONDS in place of the requested one, of koz_torque or of anything else.
 * Uses attitude, rate and zones of the situation.  The guarantee holds from states that koz_is_safe accepts on.
 */
void koz_shield(const koz_situation *now, const float requested_B[3], float allowed_B[3]);

/* Whether braking from here keeps the boresight outside all zones, with the margin. */
int koz_is_safe(const koz_situation *now);

#endif
