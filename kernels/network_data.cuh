// What goes into a network and what comes out of it: samples of a batch, inputs, outputs as log-stretch.
#pragma once
#include "answer.cuh"
#include "network.cuh"
#include "stretch.cuh"
#include "table.cuh"

namespace rw {

// How outputs become log-stretch.
struct Reading {
    float mean[3], deviation[3];
    float tau;
    int published;         // 0: output * deviation + mean; 1: tau * sign(output) (exp|output| - 1)
    float share;           // of the network, above `base`
    float times[5];        // what a point has at places that hold a time (RW_AXES); NaN: what it brings along
    float step;            // length of tangents, so that halves hold them
    float factor[3][3];    // [output][along]: tangents over it, to derivatives of arrivals in the units of the domain
    const float* further;  // what points bring along at places behind the third, PLACES - 3 each; null: nothing
    Table base;            // without values: none
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
// Log-stretch of a flow map whose outputs have these derivatives, [output][along], times the step (Objective::log_stretch_of_map).
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

// The inputs of the network, of a unit point.
RW_FN void inputs(float (&point)[DIMS], const float (&unit)[PLACES]) {
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int k = 0; k < DIMS; ++k) point[k] = unit[axes[k]];
}

// A sample: unit point and times at their places, standardised targets. One Four where that has room for it, otherwise two.
struct Sample {
    float place[PLACES];
    float target[OUTPUTS];
};
constexpr int SAMPLE_FOURS = (PLACES + OUTPUTS + 3) / 4;
static_assert(SAMPLE_FOURS <= 2, "room");

RW_FN Sample load_sample(const Four* at) {
    float values[8] = {};
    RW_UNROLL for (int i = 0; i < SAMPLE_FOURS; ++i) {
        const Four four = load(at + i);
        values[4 * i] = four.x, values[4 * i + 1] = four.y, values[4 * i + 2] = four.z, values[4 * i + 3] = four.w;
    }
    Sample sample;
    RW_UNROLL for (int k = 0; k < PLACES; ++k) sample.place[k] = values[k];
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) sample.target[k] = values[PLACES + k];
    return sample;
}

RW_FN void store_sample(Four* at, const Sample& sample) {
    float values[8] = {};
    RW_UNROLL for (int k = 0; k < PLACES; ++k) values[k] = sample.place[k];
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) values[PLACES + k] = sample.target[k];
    RW_UNROLL for (int i = 0; i < SAMPLE_FOURS; ++i) at[i] = {values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]};
}

// Nowhere, without a target.
RW_FN Sample no_sample() {
    Sample sample = {};
    RW_UNROLL for (int k = 0; k < OUTPUTS; ++k) sample.target[k] = not_a_number();
    return sample;
}

// Whether it can be learned from: all its targets are numbers, or none.
RW_FN bool is_usable(const Sample& sample) { return is_finite(sample.target[0]); }

// Of a batch: the sum over its usable samples of what is predicted less the label, in linear scale, and their number.
struct Means {
    double difference, usable;
};

// Which samples make up a batch (Pick in train.rs), and the penalty on the difference of its means.
struct Draw {
    const Four* samples;  // the first `first` of `count`
    const Four* more;     // those behind them
    uint64_t seed, counter;
    uint32_t count, first, batch;
    uint32_t random;    // 0: the first ones, in order
    uint32_t hold_out;  // samples whose number is a multiple of this are left out, where one is drawn; 0: none
    float penalty;
    const Means* means;
};
static_assert(sizeof(Draw) == 64, "layout");

// 64 random bits (module.rs).
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

RW_FN Sample drawn_sample(const Draw& draw, uint32_t position) {
    const uint32_t number = drawn(draw, position);
    const Four* from = number < draw.first ? draw.samples : draw.more;
    return load_sample(from + (number < draw.first ? number : number - draw.first) * size_t(SAMPLE_FOURS));
}

// Difference of the means of a batch.
RW_FN double mean_difference(const Draw& draw) { return draw.means->usable > 0.0 ? draw.means->difference / draw.means->usable : 0.0; }

// What the penalty adds to the loss, which is a mean over all of the batch, those included that are not usable.
RW_FN double penalty_loss(const Draw& draw) {
    const double difference = mean_difference(draw);
    return draw.penalty * difference * difference * draw.means->usable / draw.batch;
}

// Factor of exp|output| in the gradient of it, times the batch.
RW_FN float penalty_slope(const Draw& draw) { return float(2.0 * draw.penalty * mean_difference(draw)); }
#endif

}  // namespace rw
