// Regression of the correction on the marched picture. Mirrors src/render/smooth/regression.rs, which says why.
#pragma once
#include "rendering/combine.cuh"

namespace rw {

constexpr int GUIDES = 8;  // planes: radiance, opacity, opacity times mean FTLE, and that times radiance
constexpr int FEATURES = 4;
// The matrix above and on its diagonal, then the right-hand sides of both halves, then the pairs.
constexpr int MATRIX_SUMS = FEATURES * (FEATURES + 1) / 2, NORMAL_SUMS = MATRIX_SUMS + 2 * FEATURES + 1;
constexpr double RIDGE = 1e-6, FEW = 10.0;
// Pixels that a block sums at a time, floats of one of them (features and both halves' sums by channel, pairs), and threads of a sum.
constexpr int STRIP = 256, STRIP_FIELDS = 3 * (FEATURES + 2) + 1, STRIP_PARTS = 12;
constexpr int STRIP_MEMORY = STRIP * STRIP_FIELDS + NORMAL_SUMS * STRIP_PARTS;
// Threads that sum a field of all blocks.
constexpr int SOLVE_PARTS = 13, SOLVE_MEMORY = NORMAL_SUMS * (1 + SOLVE_PARTS);

struct Regression {
    const float* sums;     // planes of the sums over pairs
    const double* base;    // planes of the sums over rays
    float* guides;         // GUIDES planes
    float* around;         // GUIDES planes: filtered
    float* scratch;        // GUIDES planes
    double* partial;       // NORMAL_SUMS of each block
    double* coefficients;  // FEATURES of each half
    double per_ray;        // 1 / rays of a pixel
    int width;
    int height;
    int blocks;
    int pad;
};
static_assert(sizeof(Regression) == 80, "layout");

RW_FN void put_guides(const Regression& r, size_t at) {
    const size_t pixels = size_t(r.width) * r.height;
    for (int k = 0; k < 5; ++k) r.guides[k * pixels + at] = float(r.base[k * pixels + at] * r.per_ray);
    for (int k = 0; k < 3; ++k) r.guides[(5 + k) * pixels + at] = r.guides[4 * pixels + at] * r.guides[k * pixels + at];
}

// Filters GUIDES planes along both axes.
RW_FN void filter_guides(const float* from, float* to, int width, int height, int x, int y, int spacing) {
    const float kernel[5] = {0.0625f, 0.25f, 0.375f, 0.25f, 0.0625f};
    const size_t pixels = size_t(width) * height;
    const Taps row = taps(x, width, spacing, 1), column = taps(y, height, spacing, width);
    for (int k = 0; k < GUIDES; ++k) {
        float sum = 0.0f;
        RW_UNROLL
        for (int i = 0; i < 5; ++i) sum += kernel[i] * b3(from + k * pixels + column.at[i], row);
        to[k * pixels + size_t(y) * width + x] = sum;
    }
}

// Features of a pixel, by channel. All of them 0, and false, where nothing is shown around it.
RW_FN bool features_at(const Regression& r, size_t at, float (&features)[3][FEATURES]) {
    const size_t pixels = size_t(r.width) * r.height;
    float details[GUIDES];
    for (int k = 0; k < GUIDES; ++k) details[k] = r.guides[k * pixels + at] - r.around[k * pixels + at];
    const bool shows = r.around[3 * pixels + at] > 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float of[FEATURES] = {details[k], details[3], details[4], details[5 + k]};
        for (int i = 0; i < FEATURES; ++i) features[k][i] = shows ? of[i] : 0.0f;
    }
    return shows;
}

// Two features of a sum of the matrix.
RW_FN void matrix_place(int field, int& i, int& j) {
    i = 0;
    while (field >= FEATURES - i) field -= FEATURES - i++;
    j = i + field;
}

// Sums of the normal equations over the strips of one of `blocks` blocks.
RW_FN void sum_normal(const Block& block, const Regression& r, int number, float* memory) {
    const size_t pixels = size_t(r.width) * r.height;
    float* totals = memory + STRIP * STRIP_FIELDS;
    block.each(NORMAL_SUMS * STRIP_PARTS, [&](int i) { totals[i] = 0.0f; });
    for (size_t first = size_t(number) * STRIP; first < pixels; first += size_t(r.blocks) * STRIP) {
        block.each(STRIP, [&](int i) {
            // A field of all pixels is contiguous.
            const size_t at = first + i;
            float features[3][FEATURES] = {};
            const bool shows = at < pixels && features_at(r, at, features);
            for (int k = 0; k < 3; ++k) {
                for (int n = 0; n < FEATURES; ++n) memory[(k * FEATURES + n) * STRIP + i] = features[k][n];
                for (int half = 0; half < 2; ++half) {
                    const float* sums = r.sums + (6 * half + k) * pixels + at;
                    memory[(3 * FEATURES + 2 * k + half) * STRIP + i] = shows ? sums[0] + sums[3 * pixels] : 0.0f;
                }
            }
            const float* pairs = r.sums + PAIR_COUNTS * pixels + at;
            memory[(STRIP_FIELDS - 1) * STRIP + i] = shows ? pairs[0] + pairs[pixels] : 0.0f;
        });
        block.each(NORMAL_SUMS * STRIP_PARTS, [&](int i) {
            const int field = i / STRIP_PARTS;
            float sum = 0.0f;
            if (field < MATRIX_SUMS) {
                int a, b;
                matrix_place(field, a, b);
                for (int p = i % STRIP_PARTS; p < STRIP; p += STRIP_PARTS) {
                    float product = 0.0f;
                    for (int k = 0; k < 3; ++k) product += memory[(k * FEATURES + a) * STRIP + p] * memory[(k * FEATURES + b) * STRIP + p];
                    sum += product * memory[(STRIP_FIELDS - 1) * STRIP + p];
                }
            } else if (field == NORMAL_SUMS - 1) {
                for (int p = i % STRIP_PARTS; p < STRIP; p += STRIP_PARTS) sum += memory[(STRIP_FIELDS - 1) * STRIP + p];
            } else {
                const int half = (field - MATRIX_SUMS) / FEATURES, n = (field - MATRIX_SUMS) % FEATURES;
                for (int p = i % STRIP_PARTS; p < STRIP; p += STRIP_PARTS) {
                    for (int k = 0; k < 3; ++k) sum += memory[(k * FEATURES + n) * STRIP + p] * memory[(3 * FEATURES + 2 * k + half) * STRIP + p];
                }
            }
            totals[i] += sum;
        });
    }
    block.each(NORMAL_SUMS, [&](int field) {
        double sum = 0.0;
        for (int part = 0; part < STRIP_PARTS; ++part) sum += totals[field * STRIP_PARTS + part];
        r.partial[size_t(number) * NORMAL_SUMS + field] = sum;
    });
}

// Solves the normal equations of both halves by Cholesky factors. memory: SOLVE_MEMORY doubles.
RW_FN void solve_normal(const Block& block, const Regression& r, double* memory) {
    double* parts = memory + NORMAL_SUMS;
    block.each(NORMAL_SUMS * SOLVE_PARTS, [&](int i) {
        double sum = 0.0;
        for (int number = i / NORMAL_SUMS; number < r.blocks; number += SOLVE_PARTS) sum += r.partial[size_t(number) * NORMAL_SUMS + i % NORMAL_SUMS];
        parts[i] = sum;
    });
    block.each(NORMAL_SUMS, [&](int field) {
        double sum = 0.0;
        for (int part = 0; part < SOLVE_PARTS; ++part) sum += parts[part * NORMAL_SUMS + field];
        memory[field] = sum;
    });
    block.each(1, [&](int) {
        double factor[FEATURES][FEATURES] = {}, scale[FEATURES];
        for (int field = 0; field < MATRIX_SUMS; ++field) {
            int i, j;
            matrix_place(field, i, j);
            factor[j][i] = memory[field];
        }
        // Features have units of their own.
        for (int i = 0; i < FEATURES; ++i) scale[i] = factor[i][i] > 0.0 ? 1.0 / sqrt(factor[i][i]) : 0.0;
        const double pairs = memory[NORMAL_SUMS - 1], ridge = RIDGE + FEW / (pairs > 1.0 ? pairs : 1.0);
        bool is_solved = true;
        for (int i = 0; i < FEATURES; ++i) {
            for (int j = 0; j <= i; ++j) {
                double sum = factor[i][j] * scale[i] * scale[j] + (i == j ? ridge : 0.0);
                for (int k = 0; k < j; ++k) sum -= factor[i][k] * factor[j][k];
                is_solved = is_solved && (i != j || sum > 0.0);
                factor[i][j] = i == j ? sqrt(sum) : sum / factor[j][j];
            }
        }
        for (int half = 0; half < 2; ++half) {
            double solution[FEATURES];
            for (int i = 0; i < FEATURES; ++i) {
                double sum = memory[MATRIX_SUMS + half * FEATURES + i] * scale[i];
                for (int k = 0; k < i; ++k) sum -= factor[i][k] * solution[k];
                solution[i] = sum / factor[i][i];
            }
            for (int i = FEATURES - 1; i >= 0; --i) {
                for (int k = i + 1; k < FEATURES; ++k) solution[i] -= factor[k][i] * solution[k];
                solution[i] /= factor[i][i];
            }
            for (int i = 0; i < FEATURES; ++i) r.coefficients[half * FEATURES + i] = is_solved ? solution[i] * scale[i] : 0.0;
        }
    });
}

// Starts the correction of a half (3 planes) with what the coefficients give, and leaves of its quarters' sums (3 planes each) the rest.
RW_FN void put_rest(const Regression& r, int half, size_t at, float* rest, float* correction) {
    const size_t pixels = size_t(r.width) * r.height;
    float features[3][FEATURES];
    features_at(r, at, features);
    for (int k = 0; k < 3; ++k) {
        float regressed = 0.0f;
        for (int i = 0; i < FEATURES; ++i) regressed += features[k][i] * float(r.coefficients[half * FEATURES + i]);
        correction[k * pixels + at] = regressed;
        for (int q = 0; q < 2; ++q) {
            const float pairs = r.sums[(PAIR_COUNTS + q) * pixels + at];
            rest[(3 * q + k) * pixels + at] = r.sums[(6 * half + 3 * q + k) * pixels + at] - pairs * regressed;
        }
    }
}

}  // namespace rw
