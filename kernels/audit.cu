// A frame's audit: points drawn cell by cell, then traced and predicted by others, then residuals added up. A warp has one cell: its lanes
// draw and compare 32 points at a time, and all of them add up the same sums in the same order, which passing values around costs little.
#include "answer.cuh"
#include "audit.cuh"

using namespace rw;

struct AuditDraw {
    AuditCells cells;
    UnitBox domain;
    Land land;
};
static_assert(sizeof(AuditDraw) == 176, "layout");

// A batch: cells `first` to `first` + `count`, whose points lie from begins[cell] on in the row of all, and from 0 on in the batch's arrays.
struct AuditBatch {
    const uint32_t* begins;  // one more than there are cells
    uint32_t first, count;
};
static_assert(sizeof(AuditBatch) == 16, "layout");

struct AuditPoints {
    float* unit;         // three each
    float* points;       // three each, domain coordinates
    unsigned char* land;  // whether one lies there
    const float* traced;
    const float* lived;
    const float* predicted;
    float* optical;
};
static_assert(sizeof(AuditPoints) == 56, "layout");

extern "C" __global__ void __launch_bounds__(256) audit_draw(const __grid_constant__ AuditDraw draw, AuditBatch batch, AuditPoints at) {
    const uint32_t warp = blockIdx.x * 8u + (threadIdx.x >> 5), lane = threadIdx.x & 31u;
    if (warp >= batch.count) return;
    const uint32_t cell = batch.first + warp, end = batch.begins[cell + 1], skip = batch.begins[batch.first];
    for (uint32_t number = batch.begins[cell] + lane; number < end; number += 32u) {
        float drawn[3], point[3], unit_point[3];
        audit_point(draw.cells, cell, number, drawn);
        // As Domain::from_unit, which does not fuse either.
        for (int k = 0; k < 3; ++k) point[k] = float(plus(draw.domain.min[k], times(draw.domain.extent[k], double(drawn[k]))));
        // Where the rounded point lies: there it is traced, and there it is predicted.
        to_unit(draw.domain, point, unit_point);
        const size_t i = number - skip;
        for (int k = 0; k < 3; ++k) {
            at.unit[3 * i + k] = unit_point[k];
            at.points[3 * i + k] = point[k];
        }
        at.land[i] = is_land(draw.land, point);
    }
}

extern "C" __global__ void __launch_bounds__(256)
audit_measure(float low, float per_range, float tau, AuditBatch batch, AuditPoints at, CellFindings* __restrict__ findings) {
    const uint32_t warp = blockIdx.x * 8u + (threadIdx.x >> 5), lane = threadIdx.x & 31u;
    if (warp >= batch.count) return;
    const uint32_t cell = batch.first + warp, skip = batch.begins[batch.first];
    const uint32_t begin = batch.begins[cell] - skip, end = batch.begins[cell + 1] - skip;
    CellFindings sums = no_findings();
    for (uint32_t base = begin; base < end; base += 32u) {
        const uint32_t i = base + lane, here = end - base < 32u ? end - base : 32u;
        Residual mine = {not_a_number(), not_a_number()};
        float traced = 0.0f, lived = 0.0f;
        uint32_t land = 1u;
        if (i < end) {
            traced = at.traced[i];
            lived = at.lived[i];
            land = at.land[i];
            if (!land) mine = residual(low, per_range, tau, at.predicted[i], traced);
            at.optical[i] = mine.optical;
        }
        for (uint32_t from = 0; from < here; ++from) {
            const Residual next = {__shfl_sync(0xffffffffu, mine.optical, int(from)), __shfl_sync(0xffffffffu, mine.log_stretch, int(from))};
            add_residual(sums, next);
            add_point(sums, __shfl_sync(0xffffffffu, land, int(from)) != 0u, __shfl_sync(0xffffffffu, lived, int(from)),
                      __shfl_sync(0xffffffffu, traced, int(from)));
        }
    }
    const double mean = sums.square / sums.count;
    for (uint32_t base = begin; base < end; base += 32u) {
        const uint32_t i = base + lane, here = end - base < 32u ? end - base : 32u;
        const float optical = i < end ? at.optical[i] : not_a_number();
        for (uint32_t from = 0; from < here; ++from) add_deviation(sums, mean, __shfl_sync(0xffffffffu, optical, int(from)));
    }
    if (lane == 0u) findings[cell] = sums;
}
