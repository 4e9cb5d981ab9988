// Wavefront path tracing (Laine, Karras and Aila 2013): slots of flights advance together, wave by wave. In a wave each slot takes the answers
// at its pending collisions, ends and starts paths, flies on, and queues its next collisions.
//
// Slot g * pixels + p runs the g-th part of the samples of pixel p one after the other and adds them to its own sums. The order of summation
// thus depends on the picture's size and sample count alone, not on scheduling, and memory does not grow with the number of samples.
#pragma once
#include "rendering/tracking.cuh"

namespace rw {

constexpr uint32_t NONE = 0xFFFFFFFFu;

// A range of pixels and of samples, divided into parts that run in parallel.
struct Band {
    uint32_t first_pixel;
    uint32_t pixels;
    uint32_t parts;
    uint32_t first_sample;
    uint32_t samples;
    uint32_t pad;
};

RW_FN uint32_t part_start(const Band& band, uint32_t part) {
    return band.first_sample + (uint32_t)((uint64_t)band.samples * part / band.parts);
}

// State of the slots: one array per group of fields that are accessed together.
struct Slots {
    Float4* place;     // origin, t
    Float4* way;       // direction, end
    Float4* colour;    // radiance, weight
    Uint4* progress;   // sample, dimension and (in the upper three bits) stage and `raised`, queries, traced
    Float2* seen;      // weight and weighted FTLE of the scattering event
    uint32_t* first;   // first pending collision in the queue
    double* sums;      // PIXEL_SUM_FIELDS arrays of `count` sums
    uint32_t count;
    uint32_t pad;
};

// The pending collisions, in any order; those of one flight are linked from near to far. Answers belong to the collisions of the previous wave,
// whose records are read while new ones are written.
struct Queue {
    float* points;                // domain coordinates, three per collision
    Float4* hits;                 // t, majorant, cell, next
    uint32_t* length;
    const Float4* answered;       // records of the answered collisions
    const float* log_stretch;     // NaN: no value exists
    const unsigned char* by;      // AnsweredBy
};

RW_FN void load_flight(const Slots& slots, const Band& band, uint32_t slot, Flight& flight) {
    const Float4 place = slots.place[slot], way = slots.way[slot], colour = slots.colour[slot];
    const Uint4 progress = slots.progress[slot];
    const Float2 seen = slots.seen[slot];
    flight.origin[0] = place.x, flight.origin[1] = place.y, flight.origin[2] = place.z, flight.t = place.w;
    flight.direction[0] = way.x, flight.direction[1] = way.y, flight.direction[2] = way.z, flight.end = way.w;
    flight.path.radiance[0] = colour.x, flight.path.radiance[1] = colour.y, flight.path.radiance[2] = colour.z;
    flight.weight = colour.w;
    flight.pixel = band.first_pixel + slot % band.pixels;
    flight.sample = progress.x;
    flight.dimension = progress.y & 0x1FFFFFFFu;
    flight.raised = progress.y >> 29 & 1u;
    flight.stage = progress.y >> 30;
    flight.path.queries = progress.z;
    flight.path.traced = progress.w;
    flight.path.scattered = seen.x;
    flight.path.ftle = seen.y;
    flight.path.missing = 0.0f;
}

RW_FN void store_flight(const Slots& slots, uint32_t slot, const Flight& flight) {
    slots.place[slot] = {flight.origin[0], flight.origin[1], flight.origin[2], flight.t};
    slots.way[slot] = {flight.direction[0], flight.direction[1], flight.direction[2], flight.end};
    slots.colour[slot] = {flight.path.radiance[0], flight.path.radiance[1], flight.path.radiance[2], flight.weight};
    const uint32_t flags = flight.stage << 30 | (flight.raised ? 1u << 29 : 0u);
    slots.progress[slot] = {flight.sample, flight.dimension | flags, flight.path.queries, flight.path.traced};
    slots.seen[slot] = {flight.path.scattered, flight.path.ftle};
}

RW_FN void load_sum(const Slots& slots, uint32_t slot, PixelSum& sum) {
    double* fields = reinterpret_cast<double*>(&sum);
    RW_UNROLL
    for (int k = 0; k < PIXEL_SUM_FIELDS; ++k) fields[k] = slots.sums[slot + k * (size_t)slots.count];
}

RW_FN void store_sum(const Slots& slots, uint32_t slot, const PixelSum& sum) {
    const double* fields = reinterpret_cast<const double*>(&sum);
    RW_UNROLL
    for (int k = 0; k < PIXEL_SUM_FIELDS; ++k) slots.sums[slot + k * (size_t)slots.count] = fields[k];
}

// Queues the flight's pending collision and up to `ahead` - 1 that follow it if the flight goes on.
RW_FN void enqueue(const FrameScene& scene, const MajorantGrid& grid, const Queue& queue, const Flight& flight, Hit hit, uint32_t ahead,
                          uint32_t& first) {
    uint32_t drawn = flight.dimension - 1;
    uint32_t at = reserve(queue.length);
    first = at;
    for (uint32_t k = 1;; ++k) {
        float cell[3], point[3];
        flight_point(flight, hit.t, cell);
        domain_point(scene.box, cell, point);
        for (int a = 0; a < 3; ++a) queue.points[3 * (size_t)at + a] = point[a];
        Hit following;
        const bool more = k < ahead && look_ahead(scene, grid, flight, drawn, hit, following);
        const uint32_t next = more ? reserve(queue.length) : NONE;
        queue.hits[at] = {hit.t, hit.majorant, bits_float(hit.cell), bits_float(next)};
        if (!more) return;
        at = next;
        hit = following;
        drawn += 1;
    }
}

// One slot's part of a wave. Returns false if the slot has no more work. `fresh` slots have no path yet.
RW_FN bool advance(const FrameScene& scene, const MajorantGrid& grid, const Watch& watch, const Band& band, const Slots& slots,
                          const Queue& queue, uint32_t slot, bool fresh, uint32_t ahead_camera, uint32_t ahead_shadow, Counts& counts) {
    const uint32_t end = part_start(band, slot / band.pixels + 1);
    Flight flight = {};
    Hit hit = {0.0f, 0.0f, 0u};
    PixelSum sum = {0.0, {0.0, 0.0, 0.0, 0.0}, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    bool summed = fresh, flying = false;
    if (fresh) {
        flight.pixel = band.first_pixel + slot % band.pixels;
        flight.sample = part_start(band, slot / band.pixels);
        flying = flight.sample < end && start(scene, grid, flight.pixel, flight.sample, flight, hit);
    } else {
        load_flight(slots, band, slot, flight);
        uint32_t at = slots.first[slot];
        Verdict verdict;
        const bool was_raised = flight.raised;
        for (;;) {
            const Float4 record = queue.answered[at];
            const Answer answer = {queue.log_stretch[at], queue.by[at]};
            verdict = resolve(scene, flight, Hit{record.x, record.y, float_bits(record.z)}, answer, watch, counts);
            const uint32_t next = float_bits(record.w);
            // What follows a raised majorant was drawn under a lower one.
            if (verdict != NULL_COLLISION || next == NONE || flight.raised != was_raised) break;
            at = next;
            flight.dimension += 1;
        }
        flying = verdict != ENDED && fly(scene, grid, flight, hit);
    }
    while (!flying && flight.sample < end) {
        if (!summed) load_sum(slots, slot, sum);
        summed = true;
        add_path(sum, flight.path);
        counts.paths += 1;
        flight.sample += 1;
        if (flight.sample < end) flying = start(scene, grid, flight.pixel, flight.sample, flight, hit);
    }
    if (summed) store_sum(slots, slot, sum);
    if (!flying) return false;
    store_flight(slots, slot, flight);
    enqueue(scene, grid, queue, flight, hit, flight.stage == SHADOW ? ahead_shadow : ahead_camera, slots.first[slot]);
    return true;
}

// A pixel of the band, its parts merged in order.
RW_FN PixelValue finished(const Band& band, const Slots& slots, uint32_t pixel) {
    PixelSum sum;
    load_sum(slots, pixel, sum);
    for (uint32_t part = 1; part < band.parts; ++part) {
        PixelSum other;
        load_sum(slots, part * band.pixels + pixel, other);
        merge(sum, other);
    }
    return pixel_value(sum);
}

}  // namespace rw
