// Counter-based random numbers: a pure function of (seed, frame, pixel, sample, dimension). Philox4x32-10 of Salmon, Moraes, Dror and Shaw,
// "Parallel random numbers: as easy as 1, 2, 3" (SC 2011). Integer arithmetic only; equal bit for bit to `render::rng`.
#pragma once
#include "common/atomics.cuh"

namespace rw {

struct Words {
    uint32_t w[4];
};

RW_FN uint32_t multiply_high(uint32_t a, uint32_t b) { return (uint32_t)(((uint64_t)a * (uint64_t)b) >> 32); }

RW_FN Words philox(uint32_t c0, uint32_t c1, uint32_t c2, uint32_t c3, uint32_t k0, uint32_t k1) {
    RW_UNROLL
    for (int round = 0; round < 10; ++round) {
        const uint32_t high0 = multiply_high(0xD2511F53u, c0), low0 = 0xD2511F53u * c0;
        const uint32_t high1 = multiply_high(0xCD9E8D57u, c2), low1 = 0xCD9E8D57u * c2;
        c0 = high1 ^ c1 ^ k0;
        c2 = high0 ^ c3 ^ k1;
        c1 = low1;
        c3 = low0;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    return {{c0, c1, c2, c3}};
}

// Uniform in [0, 1) with 24 random bits, which f32 holds exactly.
RW_FN float unit(uint32_t word) { return (float)(word >> 8) * (1.0f / 16777216.0f); }

// Key and counter of one frame. The host folds the seed and the upper half of the frame number into the key.
struct FrameRandom {
    uint32_t key[2];
    uint32_t frame;
    uint32_t pad;
};

RW_FN Words words(const FrameRandom& random, uint32_t pixel, uint32_t sample, uint32_t dimension) {
    return philox(pixel, sample, dimension, random.frame, random.key[0], random.key[1]);
}

}  // namespace rw
