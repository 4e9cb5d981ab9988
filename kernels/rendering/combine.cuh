// Combination of the marched picture with its noisy correction, and the error of the result. Mirrors src/render/smooth/combine.rs, which says why.
//
// The correction of each half of the samples is shrunk, scale by scale (a-trous B3 splines, Starck and Murtagh 2006). Pictures are planes of
// width * height floats.
#pragma once
#include "rendering/march.cuh"

namespace rw {

// Planes of the sums over pairs: differences by half, quarter and channel, pairs by quarter, differences of alpha.
constexpr int PAIR_COUNTS = 12, PAIR_ALPHA = 14;

// Mirrors an index at the borders of 0..n.
RW_FN int reflected(int i, int n) {
    if (n == 1) return 0;
    while (i < 0 || i >= n) i = i < 0 ? -i : 2 * (n - 1) - i;
    return i;
}

// Both quarters of a half: radiance times weight of three channels, and weight.
struct Quarters {
    const float* planes[2][4];
};
static_assert(sizeof(Quarters) == 64, "layout");

// Offsets of the five nodes of a B3 filter at a position of 0..count, `stride` apart in memory. Those of a pixel are the same in all planes.
struct Taps {
    int at[5];
};

RW_FN Taps taps(int position, int count, int spacing, int stride) {
    Taps taps;
    RW_UNROLL
    for (int i = 0; i < 5; ++i) taps.at[i] = reflected(position + (i - 2) * spacing, count) * stride;
    return taps;
}

RW_FN float b3(const float* line, const Taps& taps) {
    const float kernel[5] = {0.0625f, 0.25f, 0.375f, 0.25f, 0.0625f};
    float sum = 0.0f;
    RW_UNROLL
    for (int i = 0; i < 5; ++i) sum += kernel[i] * line[taps.at[i]];
    return sum;
}

RW_FN float luminance(const float (&c)[3]) { return 0.2126f * c[0] + 0.7152f * c[1] + 0.0722f * c[2]; }

// Pictures of one half and one level.
struct Level {
    float* mean;    // 3 planes: mean of the quarters' details
    float* energy;  // 2 planes: product of the quarters' luminance, mean of its squares
    int width;
    int height;
};
static_assert(sizeof(Level) == 24, "layout");

// 1 / weight, 0 without weight. Its products with radiances are cheaper than quotients, which are slow where the radiance is 0.
RW_FN float reciprocal(float weight) { return weight > 0.0f ? 1.0f / weight : 0.0f; }

RW_FN void put_details(const Level& level, int at, const float (&details)[2][3], const float (&weights)[2]) {
    const size_t pixels = size_t(level.width) * level.height;
    const float per_both = reciprocal(weights[0] + weights[1]);
    for (int k = 0; k < 3; ++k) {
        level.mean[k * pixels + at] = (weights[0] * details[0][k] + weights[1] * details[1][k]) * per_both;
    }
    const float a = luminance(details[0]), b = luminance(details[1]);
    level.energy[at] = a * b;
    level.energy[pixels + at] = 0.5f * (a * a + b * b);
}

// Details of a level at a pixel from the fine picture and its row-filtered planes, 8 as in `Quarters`. `coarse`: 8 other planes.
RW_FN void split_level(const Quarters& fine, const float* rows, float* coarse, const Level& level, int x, int y, int spacing) {
    const size_t pixels = size_t(level.width) * level.height;
    const int at = y * level.width + x;
    const Taps column = taps(y, level.height, spacing, level.width);
    float details[2][3], weights[2];
    RW_UNROLL
    for (int q = 0; q < 2; ++q) {
        float smooth[4], own[4];
        RW_UNROLL
        for (int k = 0; k < 4; ++k) {
            smooth[k] = b3(rows + (4 * q + k) * pixels + x, column);
            own[k] = fine.planes[q][k][at];
        }
        RW_UNROLL
        for (int k = 0; k < 4; ++k) coarse[(4 * q + k) * pixels + at] = smooth[k];
        weights[q] = own[3];
        const float per_own = reciprocal(own[3]), per_smooth = own[3] > 0.0f ? reciprocal(smooth[3]) : 0.0f;
        for (int k = 0; k < 3; ++k) details[q][k] = own[k] * per_own - smooth[k] * per_smooth;
    }
    put_details(level, at, details, weights);
}

// The coarsest picture as the details of a last level.
RW_FN void last_level(const Quarters& coarse, const Level& level, int at) {
    float details[2][3], weights[2];
    for (int q = 0; q < 2; ++q) {
        weights[q] = coarse.planes[q][3][at];
        const float per_weight = reciprocal(weights[q]);
        for (int k = 0; k < 3; ++k) details[q][k] = coarse.planes[q][k][at] * per_weight;
    }
    put_details(level, at, details, weights);
}

// The share of the energy of a mean of quarters that is not noise.
RW_FN float gain_of(float signal, float energy) {
    return energy > 0.0f ? min_(max_(2.0f * signal / (energy + signal), 0.0f), 1.0f) : 0.0f;
}

constexpr int BOX_RADIUS = 32;  // largest radius; radii are powers of two
constexpr int BOX_ROW = 1024;   // pixels of a row that one block sums
constexpr int BOX_LINES = 16, BOX_COLUMN = 128;  // columns and rows that one block sums
constexpr int BOX_GROUP = 8;    // sums of a thread at a time
// Places of a line in shared memory. One is left out after every eight, so that threads that are eight apart meet in no bank.
RW_FN constexpr int box_place(int position) { return position + position / BOX_GROUP; }
constexpr int BOX_ROW_PLACES = box_place(BOX_ROW + 2 * BOX_RADIUS + 2 * BOX_GROUP);
constexpr int BOX_COLUMN_PLACES = box_place(BOX_COLUMN + 2 * BOX_RADIUS + 2 * BOX_GROUP);
constexpr int BOX_ROW_MEMORY = 2 * BOX_ROW_PLACES, BOX_COLUMN_MEMORY = (2 * BOX_COLUMN_PLACES + BOX_COLUMN) * BOX_LINES;
static_assert(BOX_ROW % (BOX_GROUP * BOX_GROUP) == 0 && BOX_COLUMN % (BOX_GROUP * BOX_GROUP) == 0, "whole groups of groups");

// Adds to each value the one that is APART behind it, as far as there is one.
template <int APART, int COUNT> RW_FN void add_behind(float (&values)[COUNT]) {
    RW_UNROLL
    for (int k = 0; k < COUNT - APART; ++k) values[k] += values[k + APART];
}

// Sums of 2^DOUBLINGS values each, `apart` apart, at BOX_GROUP positions that are as far apart. value(k): the k-th value.
template <int DOUBLINGS, class Value> RW_FN void doubled(Value value, float (&sums)[BOX_GROUP]) {
    float values[BOX_GROUP + (1 << DOUBLINGS) - 1];
    RW_UNROLL
    for (int k = 0; k < BOX_GROUP + (1 << DOUBLINGS) - 1; ++k) values[k] = value(k);
    if (DOUBLINGS > 0) add_behind<1>(values);
    if (DOUBLINGS > 1) add_behind<2>(values);
    if (DOUBLINGS > 2) add_behind<4>(values);
    RW_UNROLL
    for (int k = 0; k < BOX_GROUP; ++k) sums[k] = values[k];
}

template <class Value> RW_FN void doubled(int doublings, Value value, float (&sums)[BOX_GROUP]) {
    if (doublings == 3) doubled<3>(value, sums);
    else if (doublings == 2) doubled<2>(value, sums);
    else if (doublings == 1) doubled<1>(value, sums);
    else doubled<0>(value, sums);
}

// Sums of 2 radius + 1 neighbours along LINES parallel lines, `count` each, a multiple of 64. Pairs, pairs of pairs and so on are summed, which takes few
// steps and keeps small sums exact beside large ones: up to 8 neighbours at once, then up to 8 of their sums. load(line, position): positions from -radius
// on. keep(line, position, sums): BOX_GROUP sums, the first at this position, each BOX_GROUP behind the last. memory: 2 * LINES * PLACES floats.
template <int LINES, int PLACES, class Load, class Keep>
RW_FN void box_lines(const Block& block, int count, int radius, float* memory, Load load, Keep keep) {
    float* eights = memory + PLACES * LINES;
    const int length = count + 2 * radius;
    int first = 0, then = 0;
    for (int summed = 1; summed < 2 * radius; summed *= 2) first < 3 ? ++first : ++then;
    block.each((length + 2 * BOX_GROUP) * LINES, [&](int i) {
        const int position = i / LINES;
        memory[box_place(position) * LINES + i % LINES] = position < length ? load(i % LINES, position - radius) : 0.0f;
    });
    block.each((length + BOX_GROUP) / BOX_GROUP * LINES, [&](int i) {
        const int line = i % LINES, begin = i / LINES * BOX_GROUP;
        float sums[BOX_GROUP];
        doubled(first, [&](int k) { return memory[box_place(begin + k) * LINES + line]; }, sums);
        RW_UNROLL
        for (int k = 0; k < BOX_GROUP; ++k) eights[box_place(begin + k) * LINES + line] = sums[k];
    });
    block.each(count / BOX_GROUP * LINES, [&](int i) {
        const int line = i % LINES, group = i / LINES;
        const int begin = group / BOX_GROUP * (BOX_GROUP * BOX_GROUP) + group % BOX_GROUP;
        float sums[BOX_GROUP];
        doubled(then, [&](int k) { return eights[box_place(begin + BOX_GROUP * k) * LINES + line]; }, sums);
        RW_UNROLL
        for (int k = 0; k < BOX_GROUP; ++k) sums[k] += memory[box_place(begin + BOX_GROUP * k + 2 * radius) * LINES + line];
        keep(line, begin, sums);
    });
}

// Sums of `from` along row y, for pixels from x on.
RW_FN void box_row(const Block& block, const float* from, float* to, int width, int x, int y, int radius, float* memory) {
    const size_t row = size_t(y) * width;
    box_lines<1, BOX_ROW_PLACES>(
        block, BOX_ROW, radius, memory,
        [&](int, int i) { return x + i >= 0 && x + i < width ? from[row + x + i] : 0.0f; },
        [&](int, int first, const float (&sums)[BOX_GROUP]) {
            RW_UNROLL
            for (int k = 0; k < BOX_GROUP; ++k) {
                const int i = first + BOX_GROUP * k;
                if (x + i < width) to[row + x + i] = sums[k];
            }
        });
}

// Sums of two planes along columns, for a block of pixels with its corner at (x, y). use(pixels, sums of the first plane, of the second): BOX_GROUP
// pixels, those outside of the picture -1.
template <class Use>
RW_FN void box_columns(const Block& block, const float* from, int width, int height, int x, int y, int radius, float* memory, Use use) {
    const float* second = from + size_t(width) * height;
    float* first_sums = memory + 2 * BOX_COLUMN_PLACES * BOX_LINES;
    auto load = [&](const float* plane, int line, int i) {
        return x + line < width && y + i >= 0 && y + i < height ? plane[size_t(y + i) * width + x + line] : 0.0f;
    };
    box_lines<BOX_LINES, BOX_COLUMN_PLACES>(
        block, BOX_COLUMN, radius, memory, [&](int line, int i) { return load(from, line, i); },
        [&](int line, int first, const float (&sums)[BOX_GROUP]) {
            RW_UNROLL
            for (int k = 0; k < BOX_GROUP; ++k) first_sums[(first + BOX_GROUP * k) * BOX_LINES + line] = sums[k];
        });
    box_lines<BOX_LINES, BOX_COLUMN_PLACES>(
        block, BOX_COLUMN, radius, memory, [&](int line, int i) { return load(second, line, i); },
        [&](int line, int first, const float (&sums)[BOX_GROUP]) {
            float others[BOX_GROUP];
            int pixels[BOX_GROUP];
            RW_UNROLL
            for (int k = 0; k < BOX_GROUP; ++k) {
                const int i = first + BOX_GROUP * k;
                others[k] = first_sums[i * BOX_LINES + line];
                pixels[k] = x + line < width && y + i < height ? (y + i) * width + x + line : -1;
            }
            use(pixels, others, sums);
        });
}

// Adds a level, times its gains, to the shrunk correction of a half (3 planes). `sums`: energies summed along rows.
RW_FN void add_level(const Block& block, const Level& level, const float* sums, int x, int y, int radius, float* half, float* memory) {
    const size_t pixels = size_t(level.width) * level.height;
    using Sums = const float (&)[BOX_GROUP];
    box_columns(block, sums, level.width, level.height, x, y, radius, memory, [&](const int (&at)[BOX_GROUP], Sums signals, Sums energies) {
        for (int k = 0; k < 3; ++k) {
            // All reads before the first write, which they need not wait for.
            float means[BOX_GROUP], shrunk[BOX_GROUP];
            RW_UNROLL
            for (int n = 0; n < BOX_GROUP; ++n) {
                means[n] = at[n] < 0 ? 0.0f : level.mean[k * pixels + at[n]];
                shrunk[n] = at[n] < 0 ? 0.0f : half[k * pixels + at[n]];
            }
            RW_UNROLL
            for (int n = 0; n < BOX_GROUP; ++n) {
                if (at[n] >= 0) half[k * pixels + at[n]] = shrunk[n] + gain_of(signals[n], energies[n]) * means[n];
            }
        }
    });
}

enum Correction {
    LEFT = 0,    // the samples only measure the error
    SHRUNK = 1,
    SUMMED = 2
};

struct Combine {
    const float* sums;    // planes as above
    const double* base;   // RAY_FIELDS planes of sums over rays
    const float* halves;  // shrunk corrections, 3 planes of each half
    float* film;          // rgba of each pixel, then planes: mean FTLE, error, missing, samples, 1 where there are samples
    const float* errors;  // of each tile the mean square error of its other pixels and of those that are lit
    float* tiles;         // TILE_FIELDS a tile, rows of tiles from the top
    double per_ray;       // 1 / rays of a pixel
    int width;
    int height;
    int how;  // Correction
    float contrast, brightness, gamma;
    float lit;  // pixels of a larger alpha are lit
    int pad;
};
static_assert(sizeof(Combine) == 88, "layout");

constexpr int TILE = 16, TILE_PIXELS = TILE * TILE;
// Sums of the squared error, its scatter and the squared radiance, each without weight, relative and tone-mapped, the pixels that have pairs, and
// their pairs; over all pixels and over the lit ones. Then the variance of one sample, summed over the pixels that have pairs.
constexpr int ERROR_FIELDS = 11, TILE_FIELDS = 2 * ERROR_FIELDS + 1;
constexpr int TILE_STRIDE = TILE_PIXELS + 1, TILE_PARTS = 8;
constexpr int TILE_MEMORY = TILE_FIELDS * (TILE_STRIDE + TILE_PARTS);

RW_FN float tone_value(const Combine& c, float colour) { return (colour - 0.5f) * c.contrast + c.brightness; }

// Slope of the tone map.
RW_FN float tone_slope(const Combine& c, float colour) {
    const float value = tone_value(c, colour);
    if (value <= 0.0f || value >= 1.0f) return 0.0f;
    // Steep without bound at black; one 8-bit step bounds it.
    return c.contrast / c.gamma * powf(max_(value, 1.0f / 255.0f), 1.0f / c.gamma - 1.0f);
}

// Slope of the tone map between two colours; at `at` where they are the same.
RW_FN float tone_secant(const Combine& c, float at, float from) {
    const float apart = at - from;
    if (apart > -1e-3f && apart < 1e-3f) return tone_slope(c, at);
    const float to = min_(max_(tone_value(c, at), 0.0f), 1.0f), begin = min_(max_(tone_value(c, from), 0.0f), 1.0f);
    return (powf(to, 1.0f / c.gamma) - powf(begin, 1.0f / c.gamma)) / apart;
}

// One channel of a pixel: what is shown of both halves, their shrunk corrections, their means, and the halved differences between their quarters.
struct Halves {
    float shown[2], shrunk[2], mean[2], apart[2];
};

// Squared error of a channel and its scatter, with the slope k of the tone map between the shown colour and the best estimate, and t at the latter; 1 and 1
// without a tone map. quarters: 0 if the pixel has both, otherwise the sign of the one that it has.
RW_FN void squared_in(const Halves& h, int how, float k, float t, float quarters, float& squared, float& scatter) {
    const float r = 0.5f * (h.shown[0] + h.shown[1]), g = 0.5f * (h.shrunk[0] + h.shrunk[1]), product = h.mean[0] * h.mean[1];
    // g and r times the correction.
    const float guessed = 0.5f * (h.shrunk[0] * h.mean[1] + h.shrunk[1] * h.mean[0]);
    const float corrected = 0.5f * (h.shown[0] * h.mean[1] + h.shown[1] * h.mean[0]);
    const float first = (r - g) * g + guessed - corrected, second = g * g - 2.0f * guessed + product;
    squared = k * (r - g) * (k * (r - g)) + 2.0f * k * t * first + t * t * second;
    if (quarters != 0.0f) {
        scatter = quarters * (how == SUMMED ? t * (t - k) * second - t * k * product : squared);
        return;
    }
    const float left = (h.mean[0] - h.shrunk[0]) * h.apart[1] + (h.mean[1] - h.shrunk[1]) * h.apart[0];
    if (how == SUMMED) scatter = t * (t - k) * left + t * (2.0f * k - t) * h.apart[0] * h.apart[1];
    else if (how == SHRUNK) scatter = t * t * left;
    else scatter = t * t * left + t * k * (h.shrunk[0] * h.apart[1] + h.shrunk[1] * h.apart[0]);
}

// Writes a pixel of the film and its squared error. `fields`: what it adds to its tile, TILE_FIELDS values `stride` apart.
RW_FN void finish_pixel(const Combine& c, int x, int y, float* fields, int stride) {
    const size_t pixels = size_t(c.width) * c.height, at = size_t(y) * c.width + x;
    const float pairs[2] = {c.sums[PAIR_COUNTS * pixels + at], c.sums[(PAIR_COUNTS + 1) * pixels + at]};
    const float all = pairs[0] + pairs[1], most = max_(all, 1.0f);
    double base[RAY_FIELDS];
    float sums[2][2][3], shrunk[2][3];
    // All reads at once.
    RW_UNROLL
    for (int k = 0; k < RAY_FIELDS; ++k) base[k] = c.base[k * pixels + at];
    RW_UNROLL
    for (int half = 0; half < 2; ++half) {
        RW_UNROLL
        for (int k = 0; k < 3; ++k) {
            RW_UNROLL
            for (int quarter = 0; quarter < 2; ++quarter) sums[half][quarter][k] = c.sums[(6 * half + 3 * quarter + k) * pixels + at];
            shrunk[half][k] = c.halves[(3 * half + k) * pixels + at];
        }
    }
    float alpha = float(base[3] * c.per_ray);
    if (c.how == SUMMED) alpha += c.sums[PAIR_ALPHA * pixels + at] / (2.0f * most);
    // Squared error, its scatter, and squared radiance; the same in tone-mapped values.
    float colour[3], found[3][3], toned[3][3], difference = 0.0f;
    const bool known = all > 0.0f, both = pairs[0] > 0.0f && pairs[1] > 0.0f, is_lit = alpha > c.lit;
    const float quarters = both ? 0.0f : (pairs[0] > 0.0f ? 1.0f : -1.0f);
    RW_UNROLL
    for (int k = 0; k < 3; ++k) {
        Halves h;
        RW_UNROLL
        for (int half = 0; half < 2; ++half) {
            const float first = sums[half][0][k], second = sums[half][1][k];
            h.mean[half] = (first + second) / most;
            h.apart[half] = 0.5f * (first / max_(pairs[0], 1.0f) - second / max_(pairs[1], 1.0f));
            h.shrunk[half] = shrunk[half][k];
            h.shown[half] = c.how == SUMMED ? h.mean[half] : (c.how == SHRUNK ? h.shrunk[half] : 0.0f);
        }
        const float marched = float(base[k] * c.per_ray), best = marched + 0.5f * (h.shrunk[0] + h.shrunk[1]);
        colour[k] = marched + 0.5f * (h.shown[0] + h.shown[1]);
        squared_in(h, c.how, 1.0f, 1.0f, quarters, found[0][k], found[1][k]);
        squared_in(h, c.how, tone_secant(c, best, colour[k]), tone_slope(c, best), quarters, toned[0][k], toned[1][k]);
        found[2][k] = colour[k] * colour[k];
        const float slope = tone_slope(c, colour[k]);
        toned[2][k] = found[2][k] * (slope * slope);
        const float between = (h.mean[0] - h.mean[1]) * all;
        difference += between * between;
    }
    reinterpret_cast<Float4*>(c.film)[at] = {colour[0], colour[1], colour[2], alpha};
    float* planes = c.film + 4 * pixels + at;
    planes[0] = base[3] > 0.0 ? float(base[4] / base[3]) : not_a_number();
    planes[2 * pixels] = float(base[5] * c.per_ray);
    planes[3 * pixels] = 2.0f * all;
    planes[4 * pixels] = known ? 1.0f : 0.0f;
    auto put = [&](int field, float value) {
        fields[field * stride] = value;
        fields[(ERROR_FIELDS + field) * stride] = is_lit ? value : 0.0f;
    };
    RW_UNROLL
    for (int which = 0; which < 3; ++which) {
        float all_channels[3] = {0.0f, 0.0f, 0.0f};
        RW_UNROLL
        for (int k = 0; k < 3; ++k) {
            const float third = found[which][k] / 3.0f;
            all_channels[0] += third;
            all_channels[1] += third / (colour[k] * colour[k] + 0.01f);
            all_channels[2] += toned[which][k] / 3.0f;
        }
        RW_UNROLL
        for (int weighting = 0; weighting < 3; ++weighting) put(3 * which + weighting, known ? all_channels[weighting] : 0.0f);
    }
    put(9, known ? 1.0f : 0.0f);
    put(10, all);
    // Sums of the halves differ by twice the pairs times the variance of one sample.
    fields[2 * ERROR_FIELDS * stride] = known ? difference / (6.0f * all) : 0.0f;
}

// Finishes the pixels of a tile and sums over it.
RW_FN void finish_tile(const Block& block, const Combine& c, int column, int row, float* memory) {
    float* parts = memory + TILE_FIELDS * TILE_STRIDE;
    block.each(TILE_PIXELS, [&](int i) {
        const int x = column * TILE + i % TILE, y = row * TILE + i / TILE;
        if (x < c.width && y < c.height) {
            finish_pixel(c, x, y, memory + i, TILE_STRIDE);
        } else {
            for (int field = 0; field < TILE_FIELDS; ++field) memory[field * TILE_STRIDE + i] = 0.0f;
        }
    });
    block.each(TILE_FIELDS * TILE_PARTS, [&](int i) {
        const float* from = memory + i / TILE_PARTS * TILE_STRIDE + i % TILE_PARTS;
        float sum = 0.0f;
        for (int k = 0; k < TILE_PIXELS; k += TILE_PARTS) sum += from[k];
        parts[i] = sum;
    });
    block.each(TILE_FIELDS, [&](int field) {
        float sum = 0.0f;
        for (int part = 0; part < TILE_PARTS; ++part) sum += parts[field * TILE_PARTS + part];
        const int across = (c.width + TILE - 1) / TILE;
        c.tiles[(size_t(row) * across + column) * TILE_FIELDS + field] = sum;
    });
}

// The error of a pixel from the mean square errors of the tiles: linear between their middles, plus `marched` if the pixel is lit.
RW_FN void finish_error(const Combine& c, int x, int y, float marched) {
    const size_t at = size_t(y) * c.width + x;
    const int pixel[2] = {x, y}, counts[2] = {(c.width + TILE - 1) / TILE, (c.height + TILE - 1) / TILE};
    const bool is_lit = reinterpret_cast<const Float4*>(c.film)[at].w > c.lit;
    int first[2], next[2];
    float share[2];
    RW_UNROLL
    for (int k = 0; k < 2; ++k) {
        const float place = min_(max_((float(pixel[k]) + 0.5f) / float(TILE) - 0.5f, 0.0f), float(counts[k] - 1));
        first[k] = counts[k] > 1 && int(place) > counts[k] - 2 ? counts[k] - 2 : int(place);
        next[k] = first[k] + 1 < counts[k] ? first[k] + 1 : first[k];
        share[k] = place - float(first[k]);
    }
    auto along = [&](int row) {
        const float* errors = c.errors + 2 * size_t(row) * counts[0] + (is_lit ? 1 : 0);
        return errors[2 * first[0]] + share[0] * (errors[2 * next[0]] - errors[2 * first[0]]);
    };
    const float top = along(first[1]);
    const float squared = top + share[1] * (along(next[1]) - top);
    c.film[5 * size_t(c.width) * c.height + at] = sqrtf(squared + (is_lit ? marched : 0.0f));
}

}  // namespace rw
