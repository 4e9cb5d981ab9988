// The film: sums over a pixel's paths, with the variance by Welford's (1962) recurrence (see `render::film`).
#pragma once
#include "common/atomics.cuh"

namespace rw {

// Contribution of one path to its pixel.
struct PathSample {
    float radiance[3];
    float scattered;  // weight of the path if it scattered, else 0
    float ftle;       // this weight times the FTLE at the scattering event
    float missing;    // weight of the path if it left the box and met missing values, else 0
    uint32_t queries;
    uint32_t traced;
};

// Sums over some of a pixel's paths, in f64. Slots store the fields in this order.
struct PixelSum {
    double samples;
    double rgba[4];  // red, green, blue, weights of scattered paths
    double ftle;
    double missing;
    double luminance;   // Welford's running mean
    double deviations;  // sum of squared deviations
    double queries;
    double traced;
};

constexpr int PIXEL_SUM_FIELDS = 11;
static_assert(sizeof(PixelSum) == PIXEL_SUM_FIELDS * sizeof(double), "fields");

RW_FN void add_path(PixelSum& sum, const PathSample& path) {
    const double r = path.radiance[0], g = path.radiance[1], b = path.radiance[2];
    sum.samples += 1.0;
    sum.rgba[0] += r;
    sum.rgba[1] += g;
    sum.rgba[2] += b;
    sum.rgba[3] += (double)path.scattered;
    sum.ftle += (double)path.ftle;
    sum.missing += (double)path.missing;
    const double luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
    const double step = luminance - sum.luminance;
    sum.luminance += step / sum.samples;
    sum.deviations += step * (luminance - sum.luminance);
    sum.queries += (double)path.queries;
    sum.traced += (double)path.traced;
}

// Adds a later part of the pixel's samples: pairwise update of Chan, Golub and LeVeque (1983).
RW_FN void merge(PixelSum& sum, const PixelSum& other) {
    const double samples = sum.samples + other.samples;
    if (samples == 0.0) return;
    const double step = other.luminance - sum.luminance;
    sum.deviations = sum.deviations + other.deviations + step * step * sum.samples * other.samples / samples;
    sum.luminance = sum.luminance + step * other.samples / samples;
    for (int k = 0; k < 4; ++k) sum.rgba[k] += other.rgba[k];
    sum.ftle += other.ftle;
    sum.missing += other.missing;
    sum.queries += other.queries;
    sum.traced += other.traced;
    sum.samples = samples;
}

// One pixel of the finished picture, laid out as the host reads it.
struct PixelValue {
    float rgba[4];
    float ftle_mean;
    float traced;
    float variance;
    float samples;
    float missing;
    float queries;
};

RW_FN PixelValue pixel_value(const PixelSum& sum) {
    PixelValue value = {{0.0f, 0.0f, 0.0f, 0.0f}, not_a_number(), 0.0f, not_a_number(), 0.0f, 0.0f, 0.0f};
    if (sum.samples == 0.0) return value;
    value.samples = (float)sum.samples;
    for (int k = 0; k < 4; ++k) value.rgba[k] = (float)(sum.rgba[k] / sum.samples);
    if (sum.rgba[3] != 0.0) value.ftle_mean = (float)(sum.ftle / sum.rgba[3]);
    value.missing = (float)(sum.missing / sum.samples);
    if (sum.samples >= 2.0) value.variance = (float)(sum.deviations / (sum.samples * (sum.samples - 1.0)));
    value.queries = (float)sum.queries;
    if (sum.queries != 0.0) value.traced = (float)(sum.traced / sum.queries);
    return value;
}

}  // namespace rw
