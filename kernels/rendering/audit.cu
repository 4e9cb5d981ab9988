// Audit of a frame: stratified sampling of the surrogate's error, a few points in each cell of the unit cube.
//
// 1. audit_draw: draws the points of each cell.
// 2. The tracer traces them, and the surrogate predicts at them.
// 3. audit_measure: adds up each cell's residuals.
// One warp has one cell. Its lanes compare 32 points at a time; then every lane adds up the same values, exchanged by shuffles, in the order of
// the points, so that sums equal the CPU's bit for bit.
#include "rendering/answer.cuh"
#include "rendering/audit.cuh"

using namespace rw;

struct AuditDraw {
    AuditCells cells;
    UnitBox domain;
    MissingCells missing_cells;
};
static_assert(sizeof(AuditDraw) == 200, "layout");

// Cells `first` to `first` + `count`. The points of a cell are numbers begins[cell] to begins[cell + 1] of all points; the batch's arrays start
// with the points of its first cell.
struct AuditBatch {
    const uint32_t* begins;  // cells + 1 of them
    uint32_t first, count;
};
static_assert(sizeof(AuditBatch) == 16, "layout");

struct AuditPoints {
    float* unit;                // three per point
    float* points;              // three per point, domain coordinates
    unsigned char* is_missing;  // 1: the point is in a missing cell
    const float* traced;
    const float* lifetime_share;
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
        from_unit(draw.domain, drawn, point);
        // The surrogate predicts at the rounded point, which is the one that is traced.
        to_unit(draw.domain, point, unit_point);
        const size_t i = number - skip;
        for (int k = 0; k < 3; ++k) {
            at.unit[3 * i + k] = unit_point[k];
            at.points[3 * i + k] = point[k];
        }
        at.is_missing[i] = is_missing(draw.missing_cells, point);
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
        float traced = 0.0f, lifetime_share = 0.0f;
        uint32_t missing = 1u;
        if (i < end) {
            traced = at.traced[i];
            lifetime_share = at.lifetime_share[i];
            missing = at.is_missing[i];
            if (!missing) mine = residual(low, per_range, tau, at.predicted[i], traced);
            at.optical[i] = mine.optical;
        }
        for (uint32_t from = 0; from < here; ++from) {
            const Residual next = {__shfl_sync(0xffffffffu, mine.optical, int(from)), __shfl_sync(0xffffffffu, mine.log_stretch, int(from))};
            add_residual(sums, next);
            add_point(sums, __shfl_sync(0xffffffffu, missing, int(from)) != 0u, __shfl_sync(0xffffffffu, lifetime_share, int(from)),
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
