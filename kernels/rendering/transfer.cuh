// Transfer function: FTLE to extinction (a clamped linear ramp) and to albedo (polynomials, evaluated by Horner's rule). See `render::transfer`.
#pragma once
#include "common/atomics.cuh"

namespace rw {

struct Transfer {
    float low;
    float per_range;
    float extinction_max;
    int coefficients[3];   // number per channel, at most 16
    float albedo[3][16];   // lowest power first
};

// saturate((FTLE - low) / (high - low)). The FTLE is finite: callers handle missing values.
RW_FN float ramp(const Transfer& transfer, float ftle) {
    return fminf(fmaxf((ftle - transfer.low) * transfer.per_range, 0.0f), 1.0f);
}

RW_FN float extinction(const Transfer& transfer, float ftle) { return transfer.extinction_max * ramp(transfer, ftle); }

// Coefficients past a channel's own are 0, so that loops of fixed lengths do: they read constants in place, without an index.
RW_FN void albedo(const Transfer& transfer, float ftle, float (&colour)[3]) {
    const float t = 1.0f - ramp(transfer, ftle);
    const int* own = transfer.coefficients;
    const bool is_short = own[0] <= 8 && own[1] <= 8 && own[2] <= 8;
    for (int k = 0; k < 3; ++k) colour[k] = 0.0f;
    if (!is_short) {
        RW_UNROLL
        for (int i = 15; i >= 8; --i) {
            RW_UNROLL
            for (int k = 0; k < 3; ++k) colour[k] = colour[k] * t + transfer.albedo[k][i];
        }
    }
    RW_UNROLL
    for (int i = 7; i >= 0; --i) {
        RW_UNROLL
        for (int k = 0; k < 3; ++k) colour[k] = colour[k] * t + transfer.albedo[k][i];
    }
}

}  // namespace rw
