// The domain's unit cube, and the choice of traced points that are kept as labels.
#pragma once
#include "common/rng.cuh"

namespace rw {

// The domain: lower corner and edge lengths, and `field::Domain::inward_corners`.
struct UnitBox {
    double min[3], extent[3];
    float low[3], high[3];
};
static_assert(sizeof(UnitBox) == 72, "layout");

// Equals `field::Domain::from_unit`, which does not fuse multiply and add.
RW_FN void from_unit(const UnitBox& box, const float unit[3], float (&point)[3]) {
    for (int k = 0; k < 3; ++k) point[k] = fminf(fmaxf((float)plus(box.min[k], times(box.extent[k], (double)unit[k])), box.low[k]), box.high[k]);
}

// Equals `field::Domain::to_unit`.
RW_FN void to_unit(const UnitBox& box, const float point[3], float (&unit)[3]) {
    for (int k = 0; k < 3; ++k) unit[k] = min_(max_((float)(((double)point[k] - box.min[k]) / box.extent[k]), 0.0f), 1.0f);
}

// Returns true for 1 point in 2^shift: the label rule, stated in src/backend/router.rs.
RW_FN bool keeps_label(const float point[3], uint32_t shift) {
    if (shift == 0) return true;
    const Words random = philox(float_bits(point[0]), float_bits(point[1]), float_bits(point[2]), 0u, 0u, 0u);
    return shift < 32 && random.w[0] >> (32 - shift) == 0u;
}

}  // namespace rw
