// Where no particle can start, since the velocity is missing around it (see `flow::voids`).
#pragma once
#include "base.cuh"

namespace rw {

struct LandAxis {
    const double* nodes;  // ascending
    double period;        // 0: not periodic
    int count;
    int pad;
};

// Cells of the velocity grid; a periodic axis has one between its last node and the first one's image.
struct Land {
    LandAxis axes[3];
    int cells[3];
    int dimensions;
    const unsigned char* empty;  // whether a cell is, x fastest; null: no cell is
};
static_assert(sizeof(Land) == 96, "layout");

// The cell around a coordinate; the nearest one outside the axis.
RW_FN int land_cell(const LandAxis& axis, double x) {
    if (axis.period != 0.0) {
        double past = fmod(x - axis.nodes[0], axis.period);
        if (past < 0.0) past += axis.period;
        x = axis.nodes[0] + past;
    }
    // Nodes at or below x.
    int low = 0, high = axis.count;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (axis.nodes[middle] <= x) low = middle + 1;
        else high = middle;
    }
    if (axis.period != 0.0) return (low + axis.count - 1) % axis.count;
    return min_(max_(low, 1), axis.count - 1) - 1;
}

RW_FN bool is_land(const Land& land, const float point[3]) {
    if (!land.empty) return false;
    size_t index = 0, pitch = 1;
    for (int k = 0; k < land.dimensions; ++k) {
        index += pitch * size_t(land_cell(land.axes[k], double(point[k])));
        pitch *= size_t(land.cells[k]);
    }
    return land.empty[index] != 0;
}

}  // namespace rw
