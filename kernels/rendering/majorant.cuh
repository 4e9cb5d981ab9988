// The majorant grid: an upper bound on the extinction in each cell, traversed by a digital differential analyser (Amanatides and Woo 1987).
// The host derives the bounds between frames (`render::majorant`). The device records counts, maxima and flags of the values it meets, none of
// which depends on the order of threads.
#pragma once
#include "rendering/space.cuh"

namespace rw {

struct MajorantGrid {
    const float* majorants;         // x fastest
    const unsigned char* may_miss;  // 1: the cell may hold missing values
};

// Values met by the frame in progress, per cell.
struct Watch {
    uint32_t* count;
    uint32_t* highest;  // order-preserving image of the highest FTLE; 0: no value yet
    uint32_t* missing;  // 0 or 1
};

// Maps floats (not NaN) to integers of the same order.
RW_FN uint32_t ordered(float value) {
    const uint32_t bits = float_bits(value);
    return bits >> 31 ? ~bits : bits | 0x80000000u;
}

RW_FN void observe(const Watch& watch, uint32_t cell, float ftle) {
    atomic_add(&watch.count[cell], 1u);
    const uint32_t image = ordered(ftle);
    // Most values are below the maximum, so a plain read saves the atomic.
    if (image > relaxed_load(&watch.highest[cell])) atomic_max(&watch.highest[cell], image);
}

RW_FN void observe_missing(const Watch& watch, uint32_t cell) {
    atomic_add(&watch.count[cell], 1u);
    if (relaxed_load(&watch.missing[cell]) == 0u) atomic_max(&watch.missing[cell], 1u);
}

RW_FN uint32_t cell_at(const SceneBox& box, const float point[3]) {
    int index[3];
    for (int k = 0; k < 3; ++k) {
        const int i = (int)point[k];
        index[k] = i < box.cells[k] - 1 ? i : box.cells[k] - 1;
    }
    return (uint32_t)((index[2] * box.cells[1] + index[1]) * box.cells[0] + index[0]);
}

// A tentative collision.
struct Hit {
    float t;
    float majorant;
    uint32_t cell;
};

// Walks from `t` along origin + t direction (grid coordinates) until the optical depth of the majorants, each at least `least`, reaches `depth`.
// Returns false if that is beyond `end`. Visits at most as many cells as the grid has along its three axes together.
RW_FN bool walk(const SceneBox& box, const float* majorants, float least, const float origin[3], const float direction[3], float t,
                       float end, float depth, Hit& hit) {
    const int strides[3] = {1, box.cells[0], box.cells[0] * box.cells[1]};
    int index = 0;
    // Per axis: cells left before the walk leaves the grid, index step, t of the next wall, and t between walls.
    int left[3] = {0, 0, 0}, step[3] = {0, 0, 0};
    float wall[3] = {infinity(), infinity(), infinity()}, pace[3] = {0.0f, 0.0f, 0.0f};
    RW_UNROLL
    for (int k = 0; k < 3; ++k) {
        const float place = origin[k] + t * direction[k];
        int cell = (int)place;
        cell = cell < 0 ? 0 : (cell > box.cells[k] - 1 ? box.cells[k] - 1 : cell);
        index += cell * strides[k];
        if (direction[k] != 0.0f) {
            const bool ahead = direction[k] > 0.0f;
            const float inverse = 1.0f / direction[k];
            wall[k] = ((float)(cell + (ahead ? 1 : 0)) - origin[k]) * inverse;
            pace[k] = fabsf(inverse);
            left[k] = ahead ? box.cells[k] - 1 - cell : cell;
            step[k] = ahead ? strides[k] : -strides[k];
        }
    }
    for (;;) {
        // Selects rather than indexed loads keep the arrays in registers.
        const bool x = wall[0] < wall[1] && wall[0] < wall[2];
        const bool y = !(wall[0] < wall[1]) && wall[1] < wall[2];
        const float nearest = x ? wall[0] : (y ? wall[1] : wall[2]);
        const int remaining = x ? left[0] : (y ? left[1] : left[2]);
        const float stop = fminf(nearest, end);
        const float majorant = fmaxf(majorants[index], least);
        // Rounding may put a wall slightly before t.
        const float crossed = majorant * fmaxf(stop - t, 0.0f);
        if (crossed > depth) {
            hit.t = t + depth / majorant;
            hit.majorant = majorant;
            hit.cell = (uint32_t)index;
            return true;
        }
        if (nearest >= end || remaining == 0) return false;
        depth -= crossed;
        t = fmaxf(t, stop);
        if (x) {
            left[0] -= 1;
            index += step[0];
            wall[0] += pace[0];
        } else if (y) {
            left[1] -= 1;
            index += step[1];
            wall[1] += pace[1];
        } else {
            left[2] -= 1;
            index += step[2];
            wall[2] += pace[2];
        }
    }
}

}  // namespace rw
