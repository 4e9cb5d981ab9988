// The table surrogate: log-stretch at nodes i / (n - 1) of the unit domain, interpolated multilinearly. Mirrors src/surrogate/table.rs.
#pragma once
#include "common/base.cuh"

namespace rw {

struct Table {
    int nodes[3];  // one along z in two dimensions
    int dimensions;
    const float* values;  // x fastest
};
static_assert(sizeof(Table) == 24, "layout");

// Log-stretch at a unit point. A point outside is moved to the nearest one inside.
RW_FN float look_up(const Table& table, const float (&unit)[3]) {
    float f[3];
    size_t base = 0, stride[3], step = 1;
    RW_UNROLL for (int k = 0; k < 3; k++) {
        stride[k] = step;
        if (k < table.dimensions) {
            const int cells = table.nodes[k] - 1;
            const float position = min_(max_(unit[k], 0.0f), 1.0f) * float(cells);
            const int cell = min_(max_(int(position), 0), cells - 1);
            f[k] = position - float(cell);
            base += step * size_t(cell);
        }
        step *= size_t(table.nodes[k]);
    }
    auto row = [&](size_t at) {
        const float low = load(table.values + at), high = load(table.values + at + 1);
        return fma_(high - low, f[0], low);
    };
    auto plane = [&](size_t at) {
        const float low = row(at), high = row(at + stride[1]);
        return fma_(high - low, f[1], low);
    };
    const float near = plane(base);
    if (table.dimensions == 2) return near;
    return fma_(plane(base + stride[2]) - near, f[2], near);
}

}  // namespace rw
