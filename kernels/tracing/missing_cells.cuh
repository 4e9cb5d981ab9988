// Cells of the velocity grid in which no particle can start, since velocity is missing around them (see `flow::missing_cells`).
// Binary search along each axis, then one byte of a bit map.
#pragma once
#include "common/base.cuh"

namespace rw {

struct MissingCellsAxis {
    const double* nodes;  // ascending
    double period;        // 0: not periodic
    int count;
    int pad;
};

// A periodic axis has a cell between its last node and the image of the first one.
struct MissingCells {
    MissingCellsAxis axes[3];
    int cells[3];
    int dimensions;
    const unsigned char* missing;  // a byte a cell, x fastest; null: no cell is missing
};
static_assert(sizeof(MissingCells) == 96, "layout");

// The cell around a coordinate; the nearest one if the coordinate is outside the axis.
RW_FN int cell_along(const MissingCellsAxis& axis, double x) {
    if (axis.period != 0.0) {
        double past = fmod(x - axis.nodes[0], axis.period);
        if (past < 0.0) past += axis.period;
        x = axis.nodes[0] + past;
    }
    // Number of nodes at or below x.
    int low = 0, high = axis.count;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (axis.nodes[middle] <= x) low = middle + 1;
        else high = middle;
    }
    if (axis.period != 0.0) return (low + axis.count - 1) % axis.count;
    return min_(max_(low, 1), axis.count - 1) - 1;
}

// Returns true if `point` (domain coordinates) lies in a missing cell.
RW_FN bool is_missing(const MissingCells& missing_cells, const float point[3]) {
    if (!missing_cells.missing) return false;
    size_t index = 0, pitch = 1;
    for (int k = 0; k < missing_cells.dimensions; ++k) {
        index += pitch * size_t(cell_along(missing_cells.axes[k], double(point[k])));
        pitch *= size_t(missing_cells.cells[k]);
    }
    return missing_cells.missing[index] != 0;
}

}  // namespace rw
