// What goes into a network and what comes out of it: samples of a batch, inputs, outputs as log-stretch.
#pragma once
#include "answer.cuh"
#include "network.cuh"
#include "table.cuh"

namespace rw {

// How outputs become log-stretch.
struct Reading {
    float mean, deviation, tau;
    int published;  // 0: output * deviation + mean; 1: tau * sign(output) (exp|output| - 1)
    float share;    // of the network, above `base`
    float times[3]; // what a point has at places that hold a time (RW_AXES); NaN: what it brings along
    Table base;     // without values: none
};
static_assert(sizeof(Reading) == 56, "layout");

RW_FN void place_times(const Reading& reading, float (&unit)[3]) {
    RW_UNROLL for (int k = 0; k < 3; ++k) unit[k] = is_nan(reading.times[k]) ? unit[k] : reading.times[k];
}

RW_FN float read_output(const Reading& reading, float output, const float (&unit)[3]) {
    const float value = reading.published ? reading.tau * copysignf(expm1f(fabsf(output)), output) : fma_(output, reading.deviation, reading.mean);
    return reading.base.values ? fma_(reading.share, value, look_up(reading.base, unit)) : value;
}

RW_FN void read_levels(Level* levels, const Grid& grid) {
    for (int i = threadIdx.x; i < LEVELS; i += blockDim.x) levels[i] = grid.levels[i];
}

// The inputs of the network, of a unit point.
RW_FN void inputs(float (&point)[DIMS], const float (&unit)[3]) {
    const int axes[DIMS] = {RW_AXES};
    RW_UNROLL for (int k = 0; k < DIMS; ++k) point[k] = unit[axes[k]];
}

// Which samples make up a batch (Pick in train.rs).
struct Draw {
    const Four* samples;  // unit point, target: the first `first` of `count`
    const Four* more;     // those behind them
    uint64_t seed, counter;
    uint32_t count, first, batch;
    uint32_t random;    // 0: the first ones, in order
    uint32_t hold_out;  // samples whose number is a multiple of this are left out, where one is drawn; 0: none
    uint32_t pad;
};
static_assert(sizeof(Draw) == 56, "layout");

// 64 random bits (module.rs).
RW_FN uint64_t mix(uint64_t seed, uint64_t counter) {
    uint64_t z = seed * 0xD1342543DE82EF95ull + (counter + 1ull) * 0x9E3779B97F4A7C15ull;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
}

RW_FN uint32_t drawn(const Draw& draw, uint32_t position) {
    if (!draw.random) return position;
    const uint32_t index = uint32_t(__umul64hi(mix(draw.seed, draw.counter + position), draw.count));
    return draw.hold_out && index % draw.hold_out == 0u ? (index + 1u) % draw.count : index;
}

RW_FN Four drawn_sample(const Draw& draw, uint32_t position) {
    const uint32_t number = drawn(draw, position);
    return load(number < draw.first ? draw.samples + number : draw.more + (number - draw.first));
}

}  // namespace rw
