// One path, by single scattering: the free flight from the camera by delta tracking (Woodcock et al. 1965), then the transmittance toward the
// light by ratio tracking (Novak et al. 2014). States and random numbers equal those of `render::tracking`. Both walk the majorant grid and stop
// at tentative collisions, at which the extinction is queried. If an extinction exceeds its majorant, the null-collision rate is negative;
// events are then drawn in proportion to absolute rates and weighted (Galtier et al. 2013), which keeps the estimator unbiased. From there on the
// path takes the largest extinction for its majorant.
//
// Up to there, positions of a flight's tentative collisions do not depend on the answers; answers only decide how many of them the flight reaches.
// A flight may therefore query several at once (`look_ahead`). Answers beyond its end, and those of the lower majorants, are ignored.
#pragma once
#include "rendering/camera.cuh"
#include "rendering/film.cuh"
#include "rendering/light.cuh"
#include "rendering/majorant.cuh"
#include "common/rng.cuh"
#include "rendering/transfer.cuh"

namespace rw {

// Constants of a frame.
struct FrameScene {
    Camera camera;
    SceneBox box;
    Light light;
    Transfer transfer;
    FrameRandom random;
    uint32_t width, height;
    float background[3];
    float missing[3];
    float per_tau;
    float pad;
};
static_assert(sizeof(FrameScene) == 576, "the host fills this struct byte by byte");

enum Stage { CAMERA = 0, SHADOW = 1, PROBE = 2 };

// A path in flight. Positions are in grid coordinates, `t` in scene lengths from `origin`.
struct Flight {
    float origin[3];
    float direction[3];
    float t;
    float end;
    float weight;  // camera stage: weight of the path; shadow stage: transmittance so far
    uint32_t pixel;
    uint32_t sample;
    uint32_t dimension;  // of the next draw
    uint32_t stage;
    bool raised;   // the path has met an extinction above its majorant
    PathSample path;  // contribution of the path at full transmittance
};

// Counters of one thread in one wave.
struct Counts {
    uint32_t queries;
    uint32_t traced;
    uint32_t missing;
    uint32_t exceeded;
    uint32_t paths;
    uint32_t over_budget;
};
constexpr int COUNTS = 6;

// Source of an answer.
enum AnsweredBy : unsigned char {
    PREDICTED,   // the surrogate; also points in missing cells, which nobody answers
    TRACED,      // RK4
    OVER_BUDGET  // the surrogate outside the gate, since the tracing budget is spent
};

// Answer at a tentative collision.
struct Answer {
    float log_stretch;  // NaN: no value exists
    unsigned char by;   // AnsweredBy
};

RW_FN float least_majorant(const FrameScene& scene, bool raised) { return raised ? scene.transfer.extinction_max : 0.0f; }

RW_FN void flight_point(const Flight& flight, float t, float point[3]) {
    for (int k = 0; k < 3; ++k) point[k] = flight.origin[k] + t * flight.direction[k];
}

// Ends a camera path that did not scatter: it contributes the background.
RW_FN void see(Flight& flight, const float colour[3], float missing) {
    for (int k = 0; k < 3; ++k) flight.path.radiance[k] = colour[k] * flight.weight;
    flight.path.missing = missing * flight.weight;
}

// Draws the free flight of random dimension `dimension` from `t` on. Returns false past the end. `place` is a second random number of this draw.
RW_FN bool draw(const FrameScene& scene, const MajorantGrid& grid, const Flight& flight, uint32_t dimension, float t, Hit& hit,
                       float& place) {
    const Words random = words(scene.random, flight.pixel, flight.sample, dimension);
    // 1 - u lies in (0, 1].
    const float depth = -logf(1.0f - unit(random.w[0]));
    place = unit(random.w[3]);
    const float least = least_majorant(scene, flight.raised);
    return walk(scene.box, grid.majorants, least, flight.origin, flight.direction, t, flight.end, depth, hit);
}

// Flies to the next tentative collision. Returns true if `hit` needs an answer, false if the path is over.
RW_FN bool fly(const FrameScene& scene, const MajorantGrid& grid, Flight& flight, Hit& hit) {
    float place;
    const bool collides = draw(scene, grid, flight, flight.dimension, flight.t, hit, place);
    flight.dimension += 1;
    if (collides) {
        flight.t = hit.t;
        return true;
    }
    if (flight.stage == SHADOW) {
        for (int k = 0; k < 3; ++k) flight.path.radiance[k] *= flight.weight;
        return false;
    }
    // One point drawn uniformly along the ray's segment in the box decides between missing values and background. The choice does not depend on
    // majorants, so that the picture does not either. Cells known to hold no missing value need no query.
    flight.t = place * flight.end;
    float point[3];
    flight_point(flight, flight.t, point);
    const uint32_t cell = cell_at(scene.box, point);
    if (!grid.may_miss[cell]) {
        see(flight, scene.background, 0.0f);
        return false;
    }
    flight.stage = PROBE;
    hit.t = flight.t;
    hit.majorant = 0.0f;
    hit.cell = cell;
    return true;
}

// Starts the path of a sample and flies to its first tentative collision.
RW_FN bool start(const FrameScene& scene, const MajorantGrid& grid, uint32_t pixel, uint32_t sample, Flight& flight, Hit& hit) {
    const Words random = words(scene.random, pixel, sample, 0);
    const uint32_t column = pixel % scene.width, row = pixel / scene.width;
    const double x = ((double)column + (double)unit(random.w[0])) / (double)scene.width * 2.0 - 1.0;
    const double y = 1.0 - ((double)row + (double)unit(random.w[1])) / (double)scene.height * 2.0;
    double origin[3], direction[3], enter, leave;
    camera_ray(scene.camera, x, y, origin, direction);
    flight.pixel = pixel;
    flight.sample = sample;
    flight.dimension = 1;
    flight.stage = CAMERA;
    flight.raised = false;
    flight.weight = 1.0f;
    flight.t = 0.0f;
    flight.end = 0.0f;
    flight.path = PathSample{{0.0f, 0.0f, 0.0f}, 0.0f, 0.0f, 0.0f, 0u, 0u};
    grid_direction(scene.box, direction, flight.direction);
    if (!intersect(scene.box, origin, direction, enter, leave)) {
        see(flight, scene.background, 0.0f);
        return false;
    }
    double entry[3];
    for (int k = 0; k < 3; ++k) entry[k] = origin[k] + enter * direction[k];
    grid_point(scene.box, entry, flight.origin);
    flight.end = (float)(leave - enter);
    return fly(scene, grid, flight, hit);
}

// The draw that follows a hit if the hit is a null collision; `drawn` is the random dimension of the hit. Returns false if none follows.
RW_FN bool look_ahead(const FrameScene& scene, const MajorantGrid& grid, const Flight& flight, uint32_t drawn, const Hit& before,
                             Hit& hit) {
    float place;
    return flight.stage != PROBE && draw(scene, grid, flight, drawn + 1, before.t, hit, place);
}

enum Verdict {
    NULL_COLLISION,  // the flight goes on
    SCATTERED,       // the path has turned toward the light
    ENDED            // the path is over
};

// Applies the answer at the tentative collision `hit`, whose random dimension is `flight.dimension` - 1.
RW_FN Verdict resolve(const FrameScene& scene, Flight& flight, const Hit& hit, Answer answer, const Watch& watch, Counts& counts) {
    const float isotropic = 0.25f / 3.14159274f;
    // Transmittance below which Russian roulette decides whether a shadow flight goes on.
    const float roulette_below = 1.0f / 16.0f;
    counts.queries += 1;
    counts.traced += answer.by == TRACED ? 1 : 0;
    counts.over_budget += answer.by == OVER_BUDGET ? 1 : 0;
    flight.path.queries += 1;
    flight.path.traced += answer.by == TRACED ? 1 : 0;
    flight.t = hit.t;
    if (!is_finite(answer.log_stretch)) {
        counts.missing += 1;
        observe_missing(watch, hit.cell);
        if (flight.stage == PROBE) {
            see(flight, scene.missing, 1.0f);
            return ENDED;
        }
        return NULL_COLLISION;
    }
    const float ftle = answer.log_stretch * scene.per_tau;
    observe(watch, hit.cell, ftle);
    if (flight.stage == PROBE) {
        see(flight, scene.background, 0.0f);
        return ENDED;
    }
    const Words random = words(scene.random, flight.pixel, flight.sample, flight.dimension - 1);
    const float ratio = extinction(scene.transfer, ftle) / hit.majorant;
    if (ratio > 1.0f) {
        counts.exceeded += 1;
        flight.raised = true;
    }
    if (flight.stage == CAMERA) {
        const float real = ratio <= 1.0f ? ratio : ratio / (2.0f * ratio - 1.0f);
        if (unit(random.w[1]) < real) {
            if (ratio > 1.0f) flight.weight *= 2.0f * ratio - 1.0f;
            // Real collision: the path turns toward the light.
            float point[3], radiance[3], colour[3];
            double from[3], toward[3], distance;
            flight_point(flight, flight.t, point);
            scene_point(scene.box, point, from);
            light_seen_from(scene.light, from, toward, distance, radiance);
            albedo(scene.transfer, ftle, colour);
            for (int k = 0; k < 3; ++k) {
                flight.path.radiance[k] = colour[k] * radiance[k] * (isotropic * flight.weight);
                flight.origin[k] = point[k];
            }
            flight.path.scattered = flight.weight;
            flight.path.ftle = flight.weight * ftle;
            grid_direction(scene.box, toward, flight.direction);
            flight.end = fminf(exit_length(scene.box, point, flight.direction), (float)distance);
            flight.t = 0.0f;
            flight.weight = 1.0f;
            flight.stage = SHADOW;
            return SCATTERED;
        }
        if (ratio > 1.0f) flight.weight *= 1.0f - 2.0f * ratio;
        return NULL_COLLISION;
    }
    flight.weight *= 1.0f - ratio;
    const float size = fabsf(flight.weight);
    if (size < roulette_below) {
        if (unit(random.w[2]) * roulette_below >= size) {
            for (int k = 0; k < 3; ++k) flight.path.radiance[k] = 0.0f;
            return ENDED;
        }
        flight.weight = copysignf(roulette_below, flight.weight);
    }
    return NULL_COLLISION;
}

}  // namespace rw
