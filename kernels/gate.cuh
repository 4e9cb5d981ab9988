// Which points the surrogate may answer (see `trust::map`), and its answer from a table (see `surrogate::table`).
#pragma once
#include "atomics.cuh"

namespace rw {

struct Gate {
    int shape[3];
    int pad;
    const unsigned char* trusted;  // x fastest
};

// `point` in unit coordinates.
RW_FN bool trusts(const Gate& gate, const float point[3]) {
    int index[3];
    for (int k = 0; k < 3; ++k) {
        const int i = (int)(fminf(fmaxf(point[k], 0.0f), 1.0f) * (float)gate.shape[k]);
        index[k] = i < gate.shape[k] - 1 ? i : gate.shape[k] - 1;
    }
    return gate.trusted[(index[2] * gate.shape[1] + index[1]) * gate.shape[0] + index[0]] != 0;
}

// Log-stretch at the nodes of a regular grid over the unit cube, x fastest; one node along z in two dimensions.
struct Table {
    int nodes[3];
    int dimensions;
    const float* values;
};

// Multilinear interpolation at a unit point; a point outside is moved to the nearest one inside.
RW_FN float look_up(const Table& table, const float point[3]) {
    int base = 0, stride[3] = {0, 0, 0}, pitch = 1;
    float fraction[3] = {0.0f, 0.0f, 0.0f};
    for (int k = 0; k < table.dimensions; ++k) {
        const int cells = table.nodes[k] - 1;
        const float position = fminf(fmaxf(point[k], 0.0f), 1.0f) * (float)cells;
        int cell = (int)position;
        cell = cell < cells - 1 ? cell : cells - 1;
        fraction[k] = position - (float)cell;
        base += cell * pitch;
        stride[k] = pitch;
        pitch *= table.nodes[k];
    }
    const float* at = table.values + base;
    float plane[2];
    for (int z = 0; z < 2; ++z) {
        const float* corner = at + (z ? stride[2] : 0);
        const float low = corner[0] + (corner[stride[0]] - corner[0]) * fraction[0];
        const float a = corner[stride[1]], b = corner[stride[1] + stride[0]];
        const float high = a + (b - a) * fraction[0];
        plane[z] = low + (high - low) * fraction[1];
    }
    return plane[0] + (plane[1] - plane[0]) * fraction[2];
}

}  // namespace rw
