// Inputs and outputs of a network: samples of a batch, unit points and times, and log-stretch from the outputs.
#pragma once
#include "common/domain.cuh"
#include "common/stretch.cuh"
#include "network/network.cuh"
#include "tracing/table.cuh"

namespace rw {

// Parameters of the map from outputs to log-stretch.
struct Reading {
    float mean[3], deviation[3];
    float tau;
    int published;         // 0: output * deviation + mean; 1: tau * sign(output) (exp|output| - 1)
    float share;           // factor of the network above `base`
    float times[5];        // unit times at the places of a point that hold one (RW_AXES); NaN: the point's own value
    float step;            // length of tangents, within the range of half precision
    float factor[3][3];    // [output][along]: from tangents to derivatives of arrivals in domain units
    const float* further;  // the points' values at places beyond the third, PLACES - 3 each; null: 0
    Table base;            // null values: no base
};
static_assert(sizeof(Reading) == 128, "layout");

// The places of point number `at` of `points` (three floats each).
RW_FN void read_point(const Reading& reading, const float* points, size_t at, float (&unit)[PLACES]) {
    RW_UNROLL for (int k = 0; k < 3; ++k) unit[k] = points[3 * at + k];
    if constexpr (PLACES > 3) {
        RW_UNROLL for (int k = 3; k < PLACES; ++k) unit[k] = reading.further ? reading.further[(PLACES - 3) * at + k - 3] : 0.0f;
    }
}

RW_FN void place_times(const Reading& reading, float (&unit)[PLACES]) {
    RW_UNROLL for (int k = 0; k < PLACES; ++k) unit[k] = is_nan(reading.times[k]) ? unit[k] : reading.times[k];
}

RW_FN float look_up_base(const Reading& reading, const float (&unit)[PLACES]) {
    const float at[3] = {unit[0], unit[1], unit[2]};
    return look_up(reading.base, at);
}

RW_FN float read_output(const Reading& reading, float output, const float (&unit)[PLACES]) {
    const float linear = fma_(output, reading.deviation[0], reading.mean[0]);
    const float value = reading.published ? reading.tau * copysignf(expm1f(fabsf(output)), output) : linear;
    return reading.base.values ? fma_(reading.share, value, look_up_base(reading, unit)) : value;
}

#if RW_FLOW_MAP
// Log-stretch of a flow map; tangents[output][along] are the outputs' derivatives times the step (see Objective::log_stretch_of_map).
RW_FN float read_tangents(const Reading& reading, const float (&tangents)[OUTPUTS][SPACE]) {
    float jacobian[SPACE][SPACE];
    RW_UNROLL for (int output = 0; output < SPACE; ++output) {
        RW_UNROLL for (int along = 0; along < SPACE; ++along)
            jacobian[output][along] = fma_(tangents[output][along], reading.factor[output][along], output == along ? 1.0f : 0.0f);
    }
    return log_stretch(jacobian);
}
#endif

#if RW_DEVICE
RW_FN void read_levels(Level* levels, const Grid& grid) {
    for (int i = threadIdx.x; i < LEVELS; i += blockDim.x) levels[i] = grid.levels[i];
}
#endif

// Inputs of the network at a unit point.
RW_FN void inputs(float (&point)[DIMS], const float (&unit)[PLACES]) {
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int k = 0; k < DIMS; ++k) point[k] = unit[axes[k]];
}

// A sample: unit point and times at their places, standardised targets.
struct Sample {
    float place[PLACES];
    float target[OUTPUTS];
};
// Targets of the derivatives follow, if the loss has them: OUTPUTS along each axis.
constexpr int SAMPLE_VALUES = PLACES + OUTPUTS, SLOPES = RW_DERIVATIVES ? SPACE * OUTPUTS : 0;
// Float4s that hold a sample, and those that hold it without derivatives.
constexpr int SAMPLE_FLOAT4S = (SAMPLE_VALUES + SLOPES + 3) / 4, PLAIN_FLOAT4S = (SAMPLE_VALUES + 3) / 4;

RW_FN Sample load_sample(const Float4* at) {
    float values[4 * PLAIN_FLOAT4S];
    RW_UNROLL for (int i = 0; i < PLAIN_FLOAT4S; ++i) {
        const Float4 four = load(at + i);
        values[4 * i] = four.x, values[4 * i + 1] = four.y, values[4 * i + 2] = four.z, values[4 * i + 3] = four.w;
    }
    Sample sample;
    RW_UNROLL for (int k = 0; k < PLACES; ++k) sample.place[k] = values[k];
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) sample.target[k] = values[PLACES + k];
    return sample;
}

// Target of an output's derivative along an axis, in unit coordinates.
RW_FN float load_slope(const Float4* at, int along, int output) {
    return load(reinterpret_cast<const float*>(at) + SAMPLE_VALUES + along * OUTPUTS + output);
}

RW_FN void store_sample(Float4* at, const Sample& sample, [[maybe_unused]] const float (&slopes)[SPACE][OUTPUTS]) {
    float values[4 * SAMPLE_FLOAT4S] = {};
    RW_UNROLL for (int k = 0; k < PLACES; ++k) values[k] = sample.place[k];
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) values[PLACES + k] = sample.target[k];
    RW_UNROLL for (int k = 0; k < SLOPES; ++k) values[SAMPLE_VALUES + k] = slopes[k / OUTPUTS][k % OUTPUTS];
    RW_UNROLL for (int i = 0; i < SAMPLE_FLOAT4S; ++i) at[i] = {values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]};
}

// A sample without a target.
RW_FN Sample no_sample() {
    Sample sample = {};
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) sample.target[k] = not_a_number();
    return sample;
}

#if RW_DERIVATIVES
// Targets of the derivatives (see Objective::targets) from a Jacobian in domain coordinates, 9 floats in row-major order.
RW_FN void slopes_of(float (&slopes)[SPACE][OUTPUTS], const UnitBox& domain, const Reading& reading, const float* jacobian) {
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int along = 0; along < SPACE; ++along) {
        RW_UNROLL for (int output = 0; output < OUTPUTS; ++output) {
            const double ratio = domain.extent[axes[along]] / domain.extent[axes[output]];
            const float slope = float(jacobian[3 * axes[output] + axes[along]] * ratio);
            slopes[along][output] = (slope - (output == along ? 1.0f : 0.0f)) / reading.deviation[output];
        }
    }
}

// Limit on the difference of a tangent from its target, in units of the step. A larger one counts as this: a label that chaos stretches without
// bound then leaves the range of half precision to the others. NaN stays NaN.
constexpr float MAX_DIFFERENCE = 2048.0f;
RW_FN float tangent_difference(float found, float target) {
    const float difference = found - target;
    return fabsf(difference) > MAX_DIFFERENCE ? copysignf(MAX_DIFFERENCE, difference) : difference;
}
#endif

// Turns traced point number `i` (domain coordinates) and its label into a sample. From a log-stretch the target is its difference to `base`,
// scaled; from an arrival (domain coordinates, 3 floats each) it is the scaled displacement (see Objective::targets), and from a Jacobian (domain
// coordinates, 9 floats each; read if the loss has derivatives, null: NaN) the displacement's derivatives. One point in 2^held_back gets no target,
// since the host may keep it for validation; with 0 all points get one.
RW_FN void write_sample(const UnitBox& domain, const Reading& reading, const float* __restrict__ points, const float* __restrict__ labels,
                        [[maybe_unused]] const float* __restrict__ jacobians, uint32_t i, uint32_t held_back, Float4* __restrict__ samples) {
    const float point[3] = {points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2]};
    float unit[3];
    to_unit(domain, point, unit);
    Sample sample;
    read_point(reading, points, i, sample.place);
    RW_UNROLL for (int k = 0; k < 3; ++k) sample.place[k] = unit[k];
#if RW_FLOW_MAP
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) {
        const int axis = axes[k];
        const float arrival = float((double(labels[3 * size_t(i) + axis]) - domain.min[axis]) / domain.extent[axis]);
        sample.target[k] = (arrival - unit[axis] - reading.mean[k]) / reading.deviation[k];
    }
#else
    if (reading.published) {
        const float y = labels[i] / reading.tau;
        sample.target[0] = copysignf(log1pf(fabsf(y)), y);
    } else {
        const float below = reading.base.values ? look_up_base(reading, sample.place) : 0.0f;
        sample.target[0] = (labels[i] - below - reading.mean[0]) / reading.deviation[0];
    }
#endif
    float all = point[0] + point[1] + point[2], slopes[SPACE][OUTPUTS] = {};
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) all += sample.target[k];
#if RW_DERIVATIVES
    if (jacobians) slopes_of(slopes, domain, reading, jacobians + 9 * size_t(i));
    else all = not_a_number();
    // Each alone: the sum of finite derivatives may overflow.
    RW_UNROLL for (int k = 0; k < SLOPES; ++k) all = is_finite(slopes[k / OUTPUTS][k % OUTPUTS]) ? all : not_a_number();
#endif
    // A point that is not finite gets no target.
    if (!is_finite(all) || (held_back && keeps_label(point, held_back))) {
        RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) sample.target[k] = not_a_number();
    }
    place_times(reading, sample.place);
    store_sample(samples + i * size_t(SAMPLE_FLOAT4S), sample, slopes);
}

// Returns true if the sample has targets: either all of them, derivatives included, are finite or none is.
RW_FN bool is_usable(const Sample& sample) { return is_finite(sample.target[0]); }

// Sum of prediction minus label over the usable samples of a batch, in linear scale, and number of these samples.
struct Means {
    double difference, usable;
};

// Selection of a batch's samples (see Pick in train.rs), and the penalty on the difference of the batch means.
struct Draw {
    const Float4* samples;  // samples 0 to `first`
    const Float4* more;     // samples `first` to `count`
    uint64_t seed, counter;
    uint32_t count, first, batch;
    uint32_t random;    // 0: the first `batch` samples in order
    uint32_t hold_out;  // draws skip samples whose number is a multiple of this; 0: skip none
    float penalty;
    const Means* means;
};
static_assert(sizeof(Draw) == 64, "layout");

// 64 random bits by the finaliser of SplitMix64 (Steele et al. 2014); equal to `mix` in module.rs.
RW_FN uint64_t mix(uint64_t seed, uint64_t counter) {
    uint64_t z = seed * 0xD1342543DE82EF95ull + (counter + 1ull) * 0x9E3779B97F4A7C15ull;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
}

#if RW_DEVICE
RW_FN uint32_t drawn(const Draw& draw, uint32_t position) {
    if (!draw.random) return position;
    const uint32_t index = uint32_t(__umul64hi(mix(draw.seed, draw.counter + position), draw.count));
    return draw.hold_out && index % draw.hold_out == 0u ? (index + 1u) % draw.count : index;
}

RW_FN const Float4* drawn_at(const Draw& draw, uint32_t position) {
    const uint32_t number = drawn(draw, position);
    const Float4* from = number < draw.first ? draw.samples : draw.more;
    return from + (number < draw.first ? number : number - draw.first) * size_t(SAMPLE_FLOAT4S);
}

RW_FN Sample drawn_sample(const Draw& draw, uint32_t position) { return load_sample(drawn_at(draw, position)); }

// Difference of the means of a batch.
RW_FN double mean_difference(const Draw& draw) { return draw.means->usable > 0.0 ? draw.means->difference / draw.means->usable : 0.0; }

// Contribution of the penalty to the loss. The loss is a mean over the whole batch, unusable samples included.
RW_FN double penalty_loss(const Draw& draw) {
    const double difference = mean_difference(draw);
    return draw.penalty * difference * difference * draw.means->usable / draw.batch;
}

// Factor of exp|output| in the penalty's gradient, times the batch size.
RW_FN float penalty_slope(const Draw& draw) { return float(2.0 * draw.penalty * mean_difference(draw)); }
#endif

}  // namespace rw
