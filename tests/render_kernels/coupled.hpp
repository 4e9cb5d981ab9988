// Coupled paths of a list, in waves as the host of the device runs them.
#pragma once
#include "rendering/coupled.cuh"

// Reads: parameters, majorants, cells that may miss, list, sums; look-ahead, guesses per wave, paths of a band. Gives: counts, evaluated points,
// waves; difference and alpha of each path; the new sums; observations.
template <class Answers> static void coupled(const Surrogate& surrogate, const Answers& answers) {
    const FrameScene scene = take_one<FrameScene>();
    const size_t cells = size_t(scene.box.cells[0]) * scene.box.cells[1] * scene.box.cells[2];
    const auto majorants = take<float>(cells);
    const auto may_miss = take<unsigned char>(cells);
    const uint32_t pixels = scene.width * scene.height, entries = take_one<uint32_t>();
    const auto list = take<uint32_t>(entries);
    auto sums = take<float>(size_t(SUM_PLANES) * pixels);
    const uint32_t ahead = take_one<uint32_t>(), most_guesses = take_one<uint32_t>(), band = take_one<uint32_t>();

    const MajorantGrid grid = {majorants.data(), may_miss.data()};
    std::vector<uint32_t> count(cells), highest(cells), missing(cells);
    const Watch watch = {count.data(), highest.data(), missing.data()};
    const CoupledFrame frame = {scene, grid, watch, surrogate};
    // NaN shows reads before the first write.
    const Float4 none = {NAN, NAN, NAN, NAN};
    std::vector<Float4> place(band, none), way(band, none), kept_place(band, none), kept_way(band, none), factors(band, none),
        colour(band, none), found_so_far(band, none), found(2 * entries, none);
    std::vector<Float2> colour_rest(band, {NAN, NAN});
    std::vector<Uint4> progress(band);
    const CoupledSlots slots = {place.data(),  way.data(),         kept_place.data(),   kept_way.data(), factors.data(),
                                colour.data(), colour_rest.data(), found_so_far.data(), progress.data()};
    CoupledWork work = {list.data(), sums.data(), found.data(), scene.width, pixels, entries, 0, 0, 0};

    const size_t capacity = size_t(band) + most_guesses;
    std::vector<float> points(3 * capacity), log_stretch(capacity);
    std::vector<unsigned char> by(capacity);
    std::vector<Record> records[2] = {std::vector<Record>(capacity), std::vector<Record>(capacity)};
    Counts counts = {};
    uint32_t evaluated = 0, waves = 0;
    for (work.first = 0; work.first < 2 * entries; work.first += band) {
        work.count = 2 * entries - work.first < band ? 2 * entries - work.first : band;
        std::vector<uint32_t> live(work.count), next;
        for (uint32_t i = 0; i < work.count; ++i) live[i] = i;
        for (uint32_t wave = 0; !live.empty(); ++wave) {
            uint32_t length = 0, guesses = 0;
            const CoupledQueue queue = {points.data(), records[wave % 2].data(),     &length,            &guesses, most_guesses,
                                        ahead,         records[1 - wave % 2].data(), log_stretch.data(), by.data()};
            next.clear();
            // Every other wave is in reverse order: the order of slots must not matter.
            for (size_t i = 0; i < live.size(); ++i) {
                const uint32_t slot = live[wave % 2 ? live.size() - 1 - i : i];
                if (advance_coupled(frame, work, slots, queue, slot, wave == 0, counts)) next.push_back(slot);
            }
            if (length > capacity) exit(4);
            for (uint32_t i = 0; i < length; ++i) {
                const Answer answer = answers(&points[3 * i], records[wave % 2][i].s);
                log_stretch[i] = answer.log_stretch;
                by[i] = answer.by;
            }
            evaluated += length;
            waves += length ? 1 : 0;
            live.swap(next);
        }
    }
    for (uint32_t entry = 0; entry < entries; ++entry) add_pair(work, sums.data(), entry);
    give_one(counts);
    give_one(evaluated);
    give_one(waves);
    give(found);
    give(sums);
    give(count);
    give(highest);
    give(missing);
}

// Reads the surrogate's missing cells and table as for gated frames, and 1 if f equals s.
static void coupled_request() {
    const AnswerSetup setup;
    const Surrogate surrogate = {setup.table.table, setup.choice.missing_cells};
    const uint32_t equal = take_one<uint32_t>();
    if (equal) coupled(surrogate, [](const float*, float s) { return Answer{s, TRACED}; });
    // The test field, whose own missing values lie in other places than the surrogate's; the missing cells go first.
    else coupled(surrogate, [](const float* p, float) { return waves(p); });
}

// Pixels of tiles: size of the picture and tiles.
static void listed_request() {
    const auto size = take<uint32_t>(3);
    for (uint32_t number = 0; number < size[2]; ++number) {
        const PairTile tile = take_one<PairTile>();
        for (uint32_t thread = 0; thread < TILE_PIXELS; ++thread) give_one(listed_pixel(size[0], size[1], tile, number, thread));
    }
}
