// Audit points, drawn uniformly in each cell of the unit cube (stratified sampling), and the moments of the surrogate's residuals there.
// Equal bit for bit to the CPU's audit and `trust::audited`: sums are in f64, in the order of the points, rounded after every operation.
#pragma once
#include "common/rng.cuh"
#include "rendering/transfer.cuh"

namespace rw {

struct AuditCells {
    int shape[3];
    uint32_t key[2];
    uint32_t stream[3];
};
static_assert(sizeof(AuditCells) == 32, "layout");

// Point `number` of all points, in unit coordinates. It lies in `cell` (x fastest).
RW_FN void audit_point(const AuditCells& cells, uint32_t cell, uint32_t number, float (&point)[3]) {
    const uint32_t nx = uint32_t(cells.shape[0]), ny = uint32_t(cells.shape[1]);
    const uint32_t index[3] = {cell % nx, cell / nx % ny, cell / (nx * ny)};
    const Words random = philox(number, cells.stream[0], cells.stream[1], cells.stream[2], cells.key[0], cells.key[1]);
    for (int k = 0; k < 3; ++k) {
        const float n = float(cells.shape[k]), first = float(index[k]);
        const float drawn = (first + unit(random.w[k])) / n;
        // Rounding moves one point in a million over the edge of its cell.
        point[k] = uint32_t(drawn * n) == index[k] ? drawn : (first + 0.5f) / n;
    }
}

// Error of a prediction: of the transfer function's ramp, and in log-stretch.
struct Residual {
    float optical, log_stretch;
};

// NaN if the traced value is not finite. A prediction that is not finite gets the largest error.
RW_FN Residual residual(float low, float per_range, float tau, float predicted, float traced) {
    if (!is_finite(traced)) return {not_a_number(), not_a_number()};
    if (!is_finite(predicted)) return {1.0f, abs_(traced)};
    Transfer transfer = {};
    transfer.low = low;
    transfer.per_range = per_range;
    return {abs_(ramp(transfer, predicted / tau) - ramp(transfer, traced / tau)), predicted - traced};
}

// Sums over a cell's points: those of `trust::CellErrors`, then those of the points themselves.
struct CellFindings {
    double count, optical, square, fourth, second, third, log_square;
    double points;     // outside missing cells
    double lifetimes;  // sum of their lifetime shares
    double peak;       // largest finite log-stretch; minus infinity if there is none
};
static_assert(sizeof(CellFindings) == 80, "layout");

RW_FN CellFindings no_findings() { return {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -double(infinity())}; }

RW_FN void add_point(CellFindings& sums, bool missing, float lifetime_share, float traced) {
    if (missing) return;
    sums.points = plus(sums.points, 1.0);
    sums.lifetimes = plus(sums.lifetimes, double(lifetime_share));
    if (is_finite(traced)) sums.peak = max_(sums.peak, double(traced));
}

RW_FN void add_residual(CellFindings& sums, Residual residual) {
    if (is_nan(residual.optical)) return;
    const double optical = double(residual.optical), log_stretch = double(residual.log_stretch);
    const double square = times(optical, optical);
    sums.count = plus(sums.count, 1.0);
    sums.optical = plus(sums.optical, optical);
    sums.square = plus(sums.square, square);
    sums.fourth = plus(sums.fourth, times(square, square));
    sums.log_square = plus(sums.log_square, times(log_stretch, log_stretch));
}

// The second pass: central moments about the cell's mean square.
RW_FN void add_deviation(CellFindings& sums, double mean, float optical) {
    if (is_nan(optical)) return;
    const double deviation = plus(times(double(optical), double(optical)), -mean);
    const double square = times(deviation, deviation);
    sums.second = plus(sums.second, square);
    sums.third = plus(sums.third, times(square, deviation));
}

}  // namespace rw
