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

RW_FN void albedo(const Transfer& transfer, float ftle, float colour[3]) {
    const float t = 1.0f - ramp(transfer, ftle);
    for (int k = 0; k < 3; ++k) {
        float sum = 0.0f;
        for (int i = transfer.coefficients[k] - 1; i >= 0; --i) sum = sum * t + transfer.albedo[k][i];
        colour[k] = sum;
    }
}

}  // namespace rw
