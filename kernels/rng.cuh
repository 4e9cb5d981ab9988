// Counter-based random numbers, a pure function of (seed, frame, pixel, sample, dimension): Philox4x32-10 of Salmon, Moraes, Dror
// and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011). Integers only: bit for bit those of `render::rng`.
#pragma once
#include "portable.cuh"

namespace rw {

struct Words {
    u32 w[4];
};

RW_HD inline u32 multiply_high(u32 a, u32 b) { return (u32)(((u64)a * (u64)b) >> 32); }

RW_HD inline Words philox(u32 c0, u32 c1, u32 c2, u32 c3, u32 k0, u32 k1) {
    RW_UNROLL
    for (int round = 0; round < 10; ++round) {
        const u32 high0 = multiply_high(0xD2511F53u, c0), low0 = 0xD2511F53u * c0;
        const u32 high1 = multiply_high(0xCD9E8D57u, c2), low1 = 0xCD9E8D57u * c2;
        c0 = high1 ^ c1 ^ k0;
        c2 = high0 ^ c3 ^ k1;
        c1 = low1;
        c3 = low0;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    return {{c0, c1, c2, c3}};
}

// Uniform in [0, 1) with 24 random bits, exact in f32.
RW_HD inline float unit(u32 word) { return (float)(word >> 8) * (1.0f / 16777216.0f); }

// Key and frame of one frame's numbers; the host folds the seed and the upper half of the frame number into the key.
struct FrameRandom {
    u32 key[2];
    u32 frame;
    u32 pad;
};

RW_HD inline Words words(const FrameRandom& random, u32 pixel, u32 sample, u32 dimension) {
    return philox(pixel, sample, dimension, random.frame, random.key[0], random.key[1]);
}

}  // namespace rw
