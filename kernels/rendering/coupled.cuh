// Coupled paths: tracking of the traced field f less tracking of the surrogate s, on the same random numbers (see `render::smooth::coupled`).
//
// Both fields see the same tentative collisions, acceptance numbers and light rays, until one of them scatters where the other does not. Values
// of s are looked up in place; only collisions at which f takes part wait for an answer, and none in missing cells, which nobody answers.
//
// Waves are those of wavefront.cuh, but s guides the look-ahead: a path flies on as if f equalled s, through the real collision and toward the
// light, and queues what it meets. Where the true path goes the same way, the answers are there; where it does not, they are ignored. The
// result does not depend on how far a path looks ahead.
#pragma once
#include "rendering/tracking.cuh"
#include "tracing/missing_cells.cuh"
#include "tracing/table.cuh"

namespace rw {

// The fields of a coupled path. f counts positive, s negative.
enum Field { F = 0, S = 1 };

// The surrogate: log-stretch at nodes, no value in missing cells.
struct Surrogate {
    Table nodes;
    MissingCells missing_cells;
};
static_assert(sizeof(Surrogate) == 120, "layout");

// What does not change during a frame.
struct CoupledFrame {
    const FrameScene& scene;
    const MajorantGrid& grid;
    const Watch& watch;
    const Surrogate& surrogate;
};

// A ray segment that is walked. Positions are in grid coordinates, `t` and `end` in scene lengths from `origin`.
struct Segment {
    float origin[3];
    float direction[3];
    float t;
    float end;
};

// State of a path beside its segments.
struct Coupled {
    Segment way;           // camera ray or, in stage SHADOW, light ray
    Segment camera;        // in stage SHADOW: the camera ray, which the field that has not scattered flies on
    float weight[2];
    float transmittance[2];
    float colour[2][3];    // contribution at full transmittance
    bool flies[2];         // the field's camera flight goes on
    bool shines[2];        // the light ray belongs to the field
    bool in_shadow;
    bool raised;           // a field was above the majorant
    float difference[3];
    float alpha;
    uint32_t pixel, sample, dimension;
};

// A collision that waits for f, with what else decides there.
struct Collision {
    Hit hit;
    float s;          // log-stretch of the surrogate
    float decision;
    float roulette;
};

// A queued collision as the next wave reads it. It is that of a path if `t`, cell and stage are the same: a camera ray is always the same, and a
// light ray of the same place in the chain begins at the same collision.
struct alignas(16) Record {
    float t;
    float s;
    uint32_t cell;   // uppermost bit: stage SHADOW
    uint32_t next;   // following record of the path, LAST if none
};
constexpr uint32_t LAST = 0xFFFFFFFFu;
constexpr uint32_t SHADOW_CELL = 0x80000000u;

// A product that is not contracted with a later sum, so that equal contributions of both fields cancel exactly.
RW_FN float product(float a, float b) {
#if RW_DEVICE
    return __fmul_rn(a, b);
#else
    return a * b;
#endif
}

RW_FN void segment_point(const Segment& way, float t, float point[3]) {
    for (int k = 0; k < 3; ++k) point[k] = way.origin[k] + t * way.direction[k];
}

RW_FN bool takes_part(const Coupled& path, int x) { return path.in_shadow ? path.shines[x] : path.flies[x]; }

// True once neither a camera flight nor a light ray is left.
RW_FN bool is_over(const Coupled& path) { return !path.in_shadow && !path.flies[F] && !path.flies[S]; }

RW_FN uint32_t cell_of(const Coupled& path, const Hit& hit) { return hit.cell | (path.in_shadow ? SHADOW_CELL : 0u); }

// Prepares the path of a sample. Returns false if its ray misses the box, where both fields see the same background.
RW_FN bool begin(const FrameScene& scene, uint32_t pixel, uint32_t sample, Coupled& path) {
    path = Coupled{};
    path.pixel = pixel;
    path.sample = sample;
    path.dimension = 1;
    for (int x = 0; x < 2; ++x) {
        path.weight[x] = 1.0f;
        path.flies[x] = true;
    }
    const Words random = words(scene.random, pixel, sample, 0);
    const uint32_t column = pixel % scene.width, row = pixel / scene.width;
    const double x = ((double)column + (double)unit(random.w[0])) / (double)scene.width * 2.0 - 1.0;
    const double y = 1.0 - ((double)row + (double)unit(random.w[1])) / (double)scene.height * 2.0;
    double origin[3], direction[3], enter, leave, entry[3];
    camera_ray(scene.camera, x, y, origin, direction);
    if (!intersect(scene.box, origin, direction, enter, leave)) return false;
    for (int k = 0; k < 3; ++k) entry[k] = origin[k] + enter * direction[k];
    grid_point(scene.box, entry, path.way.origin);
    grid_direction(scene.box, direction, path.way.direction);
    path.way.end = (float)(leave - enter);
    return true;
}

// A camera ray leaves the box: what still flies sees the background, or the colour of missing values if a random point of the ray lies in a
// missing cell.
RW_FN void leave_box(const CoupledFrame& frame, Coupled& path, float place) {
    const float weight = (path.flies[F] ? path.weight[F] : 0.0f) - (path.flies[S] ? path.weight[S] : 0.0f);
    if (weight == 0.0f) return;
    float grid[3], domain[3];
    segment_point(path.way, place * path.way.end, grid);
    domain_point(frame.scene.box, grid, domain);
    const bool missing = is_missing(frame.surrogate.missing_cells, domain);
    for (int k = 0; k < 3; ++k) path.difference[k] += weight * (missing ? frame.scene.missing[k] : frame.scene.background[k]);
}

// A light ray ends: adds what it brings. The camera flight of the other field, if any, goes on.
RW_FN void end_shadow(Coupled& path) {
    RW_UNROLL
    for (int x = 0; x < 2; ++x) {
        if (!path.shines[x]) continue;
        for (int k = 0; k < 3; ++k) {
            const float brought = product(path.colour[x][k], path.transmittance[x]);
            path.difference[k] += x == F ? brought : -brought;
        }
        path.shines[x] = false;
    }
    path.in_shadow = false;
    path.way = path.camera;
}

// Decides what happens at a collision. `log_stretch` holds a value for each field that takes part.
RW_FN void collide(const FrameScene& scene, Coupled& path, const Collision& at, const float log_stretch[2]) {
    const float isotropic = 0.25f / 3.14159274f;
    const float roulette_below = 1.0f / 16.0f;
    if (path.in_shadow) {
        float size = 0.0f;
        RW_UNROLL
        for (int x = 0; x < 2; ++x) {
            if (!path.shines[x]) continue;
            const float ratio = extinction(scene.transfer, log_stretch[x] * scene.per_tau) / at.hit.majorant;
            path.raised |= ratio > 1.0f;
            path.transmittance[x] *= 1.0f - ratio;
            size = fmaxf(size, fabsf(path.transmittance[x]));
        }
        if (size >= roulette_below) return;
        // One roulette for both fields.
        const bool ends = at.roulette * roulette_below >= size;
        const float factor = ends ? 0.0f : roulette_below / size;
        RW_UNROLL
        for (int x = 0; x < 2; ++x) path.transmittance[x] *= factor;
        if (ends) end_shadow(path);
        return;
    }
    bool scattered = false;
    float point[3], radiance[3];
    double from[3], toward[3], distance;
    RW_UNROLL
    for (int x = 0; x < 2; ++x) {
        if (!path.flies[x]) continue;
        const float ftle = log_stretch[x] * scene.per_tau;
        const float ratio = extinction(scene.transfer, ftle) / at.hit.majorant;
        path.raised |= ratio > 1.0f;
        const float real = ratio <= 1.0f ? ratio : ratio / (2.0f * ratio - 1.0f);
        if (at.decision >= real) {
            if (ratio > 1.0f) path.weight[x] *= 1.0f - 2.0f * ratio;
            continue;
        }
        if (ratio > 1.0f) path.weight[x] *= 2.0f * ratio - 1.0f;
        if (!scattered) {
            segment_point(path.way, path.way.t, point);
            scene_point(scene.box, point, from);
            light_seen_from(scene.light, from, toward, distance, radiance);
        }
        float colour[3];
        albedo(scene.transfer, ftle, colour);
        for (int k = 0; k < 3; ++k) path.colour[x][k] = colour[k] * radiance[k] * (isotropic * path.weight[x]);
        path.alpha += x == F ? path.weight[x] : -path.weight[x];
        path.transmittance[x] = 1.0f;
        path.flies[x] = false;
        path.shines[x] = true;
        scattered = true;
    }
    if (!scattered) return;
    path.camera = path.way;
    for (int k = 0; k < 3; ++k) path.way.origin[k] = point[k];
    grid_direction(scene.box, toward, path.way.direction);
    path.way.t = 0.0f;
    path.way.end = fminf(exit_length(scene.box, point, path.way.direction), (float)distance);
    path.in_shadow = true;
}

// Applies the answer of f at the collision that the path waits at.
RW_FN void take_answer(const CoupledFrame& frame, Coupled& path, const Collision& at, Answer answer, Counts& counts) {
    counts.queries += 1;
    counts.traced += answer.by == TRACED ? 1 : 0;
    counts.over_budget += answer.by == OVER_BUDGET ? 1 : 0;
    if (!is_finite(answer.log_stretch)) {
        counts.missing += 1;
        observe_missing(frame.watch, at.hit.cell);
        return;
    }
    const float ftle = answer.log_stretch * frame.scene.per_tau;
    observe(frame.watch, at.hit.cell, ftle);
    counts.exceeded += extinction(frame.scene.transfer, ftle) > at.hit.majorant ? 1 : 0;
    const float log_stretch[2] = {answer.log_stretch, at.s};
    collide(frame.scene, path, at, log_stretch);
}

// Flies on to the next collision that needs f, past those that do not. Returns false if the path is over. `known` is a record that may be of
// this collision, which saves the look-up. Guesses about the path's way on are not counted.
RW_FN bool fly_on(const CoupledFrame& frame, Coupled& path, const Record& known, bool guess, Collision& at, Counts& counts) {
    const FrameScene& scene = frame.scene;
    while (!is_over(path)) {
        const Words random = words(scene.random, path.pixel, path.sample, path.dimension);
        path.dimension += 1;
        // 1 - u lies in (0, 1].
        const float depth = -logf(1.0f - unit(random.w[0]));
        const float least = least_majorant(scene, path.raised);
        if (!walk(scene.box, frame.grid.majorants, least, path.way.origin, path.way.direction, path.way.t, path.way.end, depth, at.hit)) {
            if (path.in_shadow) {
                end_shadow(path);
                continue;
            }
            if (!guess) leave_box(frame, path, unit(random.w[3]));
            return false;
        }
        path.way.t = at.hit.t;
        at.decision = unit(random.w[1]);
        at.roulette = unit(random.w[2]);
        const bool needs_f = takes_part(path, F);
        if (needs_f && known.t == at.hit.t && known.cell == cell_of(path, at.hit)) {
            at.s = known.s;
            return true;
        }
        float grid[3], domain[3], unit_point[3];
        segment_point(path.way, at.hit.t, grid);
        domain_point(scene.box, grid, domain);
        if (is_missing(frame.surrogate.missing_cells, domain)) {
            // A null collision for both. It counts as a query of f, though nobody has to be asked.
            if (needs_f && !guess) {
                counts.queries += 1;
                counts.missing += 1;
                observe_missing(frame.watch, at.hit.cell);
            }
            continue;
        }
        for (int k = 0; k < 3; ++k) unit_point[k] = grid[k] / (float)scene.box.cells[k];
        at.s = look_up(frame.surrogate.nodes, unit_point);
        if (needs_f) return true;
        const float log_stretch[2] = {at.s, at.s};
        collide(scene, path, at, log_stretch);
    }
    return false;
}

// State of the slots: one array per group of fields that are accessed together. `kept` and the colours are read in stage SHADOW only.
struct CoupledSlots {
    Float4* place;         // way: origin, t
    Float4* way;           // direction, end
    Float4* kept_place;    // camera: origin, t
    Float4* kept_way;      // direction, end
    Float4* factors;       // weights, transmittances
    Float4* colour;        // of f, and red of s
    Float2* colour_rest;   // green and blue of s
    Float4* found;         // difference, alpha
    Uint4* progress;       // dimension, sample and (in the upper five bits) flags, first record, `raised`
};
static_assert(sizeof(CoupledSlots) == 72, "layout");

RW_FN void load_path(const CoupledSlots& slots, uint32_t slot, Coupled& path, uint32_t& first) {
    const Uint4 progress = slots.progress[slot];
    const Float4 place = slots.place[slot], way = slots.way[slot], factors = slots.factors[slot], found = slots.found[slot];
    path = Coupled{};
    path.dimension = progress.x;
    path.sample = progress.y & 0x07FFFFFFu;
    path.flies[F] = progress.y >> 27 & 1u;
    path.flies[S] = progress.y >> 28 & 1u;
    path.shines[F] = progress.y >> 29 & 1u;
    path.shines[S] = progress.y >> 30 & 1u;
    path.in_shadow = progress.y >> 31;
    first = progress.z;
    path.raised = progress.w != 0;
    path.way = {{place.x, place.y, place.z}, {way.x, way.y, way.z}, place.w, way.w};
    path.weight[F] = factors.x, path.weight[S] = factors.y;
    path.transmittance[F] = factors.z, path.transmittance[S] = factors.w;
    path.difference[0] = found.x, path.difference[1] = found.y, path.difference[2] = found.z, path.alpha = found.w;
    if (!path.in_shadow) return;
    const Float4 colour = slots.colour[slot];
    const Float2 rest = slots.colour_rest[slot];
    path.colour[F][0] = colour.x, path.colour[F][1] = colour.y, path.colour[F][2] = colour.z;
    path.colour[S][0] = colour.w, path.colour[S][1] = rest.x, path.colour[S][2] = rest.y;
    if (!path.flies[F] && !path.flies[S]) return;
    const Float4 kept_place = slots.kept_place[slot], kept_way = slots.kept_way[slot];
    path.camera = {{kept_place.x, kept_place.y, kept_place.z}, {kept_way.x, kept_way.y, kept_way.z}, kept_place.w, kept_way.w};
}

RW_FN void store_path(const CoupledSlots& slots, uint32_t slot, const Coupled& path, uint32_t first) {
    const uint32_t flags = (path.flies[F] ? 1u : 0u) | (path.flies[S] ? 2u : 0u) | (path.shines[F] ? 4u : 0u) | (path.shines[S] ? 8u : 0u) |
                           (path.in_shadow ? 16u : 0u);
    slots.progress[slot] = {path.dimension, path.sample | flags << 27, first, path.raised ? 1u : 0u};
    slots.place[slot] = {path.way.origin[0], path.way.origin[1], path.way.origin[2], path.way.t};
    slots.way[slot] = {path.way.direction[0], path.way.direction[1], path.way.direction[2], path.way.end};
    slots.factors[slot] = {path.weight[F], path.weight[S], path.transmittance[F], path.transmittance[S]};
    slots.found[slot] = {path.difference[0], path.difference[1], path.difference[2], path.alpha};
    if (!path.in_shadow) return;
    slots.colour[slot] = {path.colour[F][0], path.colour[F][1], path.colour[F][2], path.colour[S][0]};
    slots.colour_rest[slot] = {path.colour[S][1], path.colour[S][2]};
    if (!path.flies[F] && !path.flies[S]) return;
    slots.kept_place[slot] = {path.camera.origin[0], path.camera.origin[1], path.camera.origin[2], path.camera.t};
    slots.kept_way[slot] = {path.camera.direction[0], path.camera.direction[1], path.camera.direction[2], path.camera.end};
}

// The queue of a wave. Records alternate between two arrays, since those of the previous wave are read while new ones are written.
struct CoupledQueue {
    float* points;               // domain coordinates, three per collision
    Record* records;
    uint32_t* length;
    uint32_t* guesses;           // asked for beyond one collision per path
    uint32_t most_guesses;       // room for them
    uint32_t ahead;              // limit on the collisions of a path
    const Record* answered;
    const float* log_stretch;    // NaN: no value exists
    const unsigned char* by;     // AnsweredBy
};
static_assert(sizeof(CoupledQueue) == 64 && sizeof(Record) == 16, "layout");

// The list of a frame: an entry is a pixel that gets one pair of paths. Path 2 i + h is sample 2 v + h of entry i, and v is the number of pairs
// that the pixel has had.
struct CoupledWork {
    const uint32_t* list;
    const float* sums;   // SUM_PLANES arrays of `pixels` values
    Float4* found;       // per path of the list: difference, alpha
    uint32_t width;      // of the picture
    uint32_t pixels;
    uint32_t entries;
    uint32_t first;      // first path of the band
    uint32_t count;      // paths of the band, one a slot
    uint32_t pad;
};
static_assert(sizeof(CoupledWork) == 48, "layout");

// Planes of the sums: differences by half, quarter and channel, then pairs by quarter, differences of alpha.
constexpr uint32_t PAIR_PLANE = 12, ALPHA_PLANE = 14, SUM_PLANES = 15;

RW_FN float& sum_at(float* sums, uint32_t pixels, uint32_t plane, uint32_t pixel) { return sums[(size_t)plane * pixels + pixel]; }

RW_FN uint32_t pairs_before(const float* sums, uint32_t pixels, uint32_t pixel) {
    return (uint32_t)(sums[(size_t)PAIR_PLANE * pixels + pixel] + sums[(size_t)(PAIR_PLANE + 1) * pixels + pixel]);
}

// One slot's part of a wave. Returns false if its path is over; the result is then in `work`. `fresh` slots have no path yet.
RW_FN bool advance_coupled(const CoupledFrame& frame, const CoupledWork& work, const CoupledSlots& slots, const CoupledQueue& queue,
                           uint32_t slot, bool fresh, Counts& counts) {
    const uint32_t number = work.first + slot;
    const uint32_t pixel = work.list[number / 2];
    const Record nothing = {-1.0f, 0.0f, LAST, LAST};
    Coupled path;
    Collision at = {};
    float f = 0.0f;                // value of f at `at`, if `resolves`
    unsigned char by = TRACED;
    Record known = nothing;        // answered record that may be of the next collision
    uint32_t known_at = LAST;
    bool resolves = !fresh;
    if (fresh) {
        const uint32_t sample = 2 * pairs_before(work.sums, work.pixels, pixel) + (number & 1u);
        if (!begin(frame.scene, pixel, sample, path)) path.flies[F] = path.flies[S] = false;
    } else {
        uint32_t first;
        load_path(slots, slot, path, first);
        path.pixel = pixel;
        const Record record = queue.answered[first];
        const uint32_t cell = record.cell & ~SHADOW_CELL;
        const Words random = words(frame.scene.random, pixel, path.sample, path.dimension - 1);
        const float majorant = fmaxf(frame.grid.majorants[cell], least_majorant(frame.scene, path.raised));
        at = {{record.t, majorant, cell}, record.s, unit(random.w[1]), unit(random.w[2])};
        f = queue.log_stretch[first];
        by = queue.by[first];
        known_at = record.next;
    }
    // First the path takes its answers as far as they go, then it looks ahead. One loop for both keeps the kernel small.
    bool guess = false;
    uint32_t queued = LAST, collisions = 0;
    Record record = nothing;
    for (;;) {
        if (resolves && guess) {
            const float log_stretch[2] = {at.s, at.s};
            collide(frame.scene, path, at, log_stretch);
        } else if (resolves) {
            take_answer(frame, path, at, {f, by}, counts);
        }
        resolves = true;
        known = known_at == LAST ? nothing : queue.answered[known_at];
        const bool waits = fly_on(frame, path, known, guess, at, counts);
        if (!guess) {
            if (!waits) {
                work.found[number] = {path.difference[0], path.difference[1], path.difference[2], path.alpha};
                counts.paths += 1;
                return false;
            }
            if (known_at != LAST && known.t == at.hit.t && known.cell == cell_of(path, at.hit)) {
                f = queue.log_stretch[known_at];
                by = queue.by[known_at];
                known_at = known.next;
                continue;
            }
            known_at = LAST;
        }
        const bool more = waits && (!guess || (collisions < queue.ahead && reserve(queue.guesses) < queue.most_guesses));
        const uint32_t next = more ? reserve(queue.length) : LAST;
        if (guess) {
            record.next = next;
            queue.records[queued] = record;
        } else {
            store_path(slots, slot, path, next);
            guess = true;
        }
        if (!more) return true;
        float grid[3], domain[3];
        segment_point(path.way, at.hit.t, grid);
        domain_point(frame.scene.box, grid, domain);
        for (int k = 0; k < 3; ++k) queue.points[3 * (size_t)next + k] = domain[k];
        record = {at.hit.t, at.s, cell_of(path, at.hit), LAST};
        queued = next;
        collisions += 1;
    }
}

RW_FN uint32_t bit_parity(uint32_t bits) {
    for (uint32_t shift = 16; shift > 0; shift >>= 1) bits ^= bits >> shift;
    return bits & 1u;
}

// Adds the two paths of an entry to the sums of its pixel. The parity of the bits of both coordinates halves the pixels of every level of the Bayer
// order between the quarters; pairs of a pixel alternate.
RW_FN void add_pair(const CoupledWork& work, float* sums, uint32_t entry) {
    const uint32_t pixel = work.list[entry];
    const uint32_t pair = pairs_before(sums, work.pixels, pixel);
    const uint32_t quarter = (bit_parity(pixel % work.width) + bit_parity(pixel / work.width) + pair) & 1u;
    float alpha = 0.0f;
    for (uint32_t half = 0; half < 2; ++half) {
        const Float4 found = work.found[2 * entry + half];
        const float difference[3] = {found.x, found.y, found.z};
        for (uint32_t k = 0; k < 3; ++k) sum_at(sums, work.pixels, 3 * (2 * half + quarter) + k, pixel) += difference[k];
        alpha += found.w;
    }
    sum_at(sums, work.pixels, PAIR_PLANE + quarter, pixel) += 1.0f;
    sum_at(sums, work.pixels, ALPHA_PLANE, pixel) += alpha;
}

// Pixels per tile edge of the list.
constexpr uint32_t TILE_EDGE = 16, TILE_PIXELS = TILE_EDGE * TILE_EDGE;

// A tile's pairs in a frame: the pixels whose rank lies in [cursor, cursor + count) modulo 256, written from `offset` on.
struct PairTile {
    uint32_t offset;
    uint16_t count;
    uint16_t cursor;
};
static_assert(sizeof(PairTile) == 8, "layout");

// Rank of a pixel in the 16 x 16 Bayer order (Bayer 1973): the bits of x ^ y and y, interleaved with x ^ y ahead, in reverse order. Every four
// ranks from a multiple of four on are spread over the tile's quarters, and so on.
RW_FN uint32_t bayer_rank(uint32_t x, uint32_t y) {
    uint32_t rank = 0;
    for (uint32_t bit = 0; bit < 4; ++bit) rank = rank << 2 | ((x ^ y) >> bit & 1u) << 1 | (y >> bit & 1u);
    return rank;
}

// The pixel of a thread of a tile, or LAST if it gets no pair in this frame or lies outside of the picture.
RW_FN uint32_t listed_pixel(uint32_t width, uint32_t height, const PairTile& tile, uint32_t number, uint32_t thread) {
    const uint32_t tiles_across = (width + TILE_EDGE - 1) / TILE_EDGE;
    const uint32_t x = thread % TILE_EDGE, y = thread / TILE_EDGE;
    const uint32_t column = number % tiles_across * TILE_EDGE + x, row = number / tiles_across * TILE_EDGE + y;
    const bool listed = ((bayer_rank(x, y) - tile.cursor) & (TILE_PIXELS - 1)) < tile.count;
    return listed && column < width && row < height ? row * width + column : LAST;
}

}  // namespace rw
