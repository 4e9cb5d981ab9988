// The gate: a map of cells of the unit cube in which the surrogate's measured error is within tolerance (see `trust::map`).
#pragma once
#include "common/atomics.cuh"

namespace rw {

struct Gate {
    int shape[3];
    int pad;
    const unsigned char* trusted;  // a byte a cell, x fastest; null: no surrogate
};

// Returns true if the surrogate may answer at `point` (unit coordinates).
RW_FN bool trusts(const Gate& gate, const float point[3]) {
    int index[3];
    for (int k = 0; k < 3; ++k) {
        const int i = (int)(fminf(fmaxf(point[k], 0.0f), 1.0f) * (float)gate.shape[k]);
        index[k] = i < gate.shape[k] - 1 ? i : gate.shape[k] - 1;
    }
    return gate.trusted[(index[2] * gate.shape[1] + index[1]) * gate.shape[0] + index[0]] != 0;
}

}  // namespace rw
