/* Publishes a solver's velocity field to ridgewatch: a copy into shared memory, and nothing else.
 *
 * No threads, no sockets, no memory taken between rw_open and rw_close (not even by a call that fails), no abort: every call returns a
 * status. Handles may be used by several threads, but nothing here from a signal handler (threads exclude each other by a mutex); a fork
 * must open its own. All calls accept a null handle and do nothing then (RW_OFF), so that a solver may be linked for good and publishes
 * only where RIDGEWATCH_RING is set.
 *
 *     rw_field *field = NULL;
 *     rw_description *d = rw_describe(3);
 *     rw_describe_uniform(d, 0, 0.0, 1.0, nx, 0.0);      // x: first node, last node, nodes, period (0: none)
 *     rw_describe_uniform(d, 1, 0.0, 1.0, ny, 0.0);
 *     rw_describe_uniform(d, 2, 0.0, 1.0, nz, 0.0);
 *     if (rw_open(NULL, d, &field) > RW_OFF) fprintf(stderr, "%s\n", rw_error());
 *     rw_free_description(d);
 *     ... rw_publish_f32(field, step, time, u, v, w);    // u[k][j][i]: x fastest
 *     rw_close(field);
 *
 * This file is generated from the library's source (make header). */


#ifndef RIDGEWATCH_H
#define RIDGEWATCH_H

#include <stdint.h>

// Of this version of the header.
#define RW_VERSION 2

// What a call came to.
typedef enum {
  // Done.
  RW_OK = 0,
  // No handle, or no ring was asked for: nothing was done.
  RW_OFF = 1,
  // A value that cannot be.
  RW_ARGUMENT = 2,
  // Another producer has this name.
  RW_IN_USE = 3,
  // No room for the ring, or it is a longer file than the process may make.
  RW_NO_SPACE = 4,
  // The folder or file belongs to somebody else.
  RW_FOREIGN = 5,
  // The system refused, or has no memory.
  RW_SYSTEM = 6,
  // The handle was opened by the parent process.
  RW_FORKED = 7,
  // A fault of this library, which was caught.
  RW_INTERNAL = 8,
} rw_status;

// A grid as far as it is described.
typedef struct rw_description rw_description;

// An open ring.
typedef struct rw_field rw_field;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// The library's version; another number than `RW_VERSION`: another header.
uint32_t rw_version(void);

// Why the last call of this thread failed; empty when none did. Valid until the thread's next call.
const char *rw_error(void);

// Makes this text what `rw_error` returns: for modules of other languages, which refuse what they do not pass on. Null: none. Takes no memory.
void rw_set_error(const char *text);

// Begins a description of a grid of 2 or 3 dimensions, whose velocity has as many components. Null when there is no memory or the
// dimensions are wrong.
rw_description *rw_describe(uint32_t dimensions);

// Ends a description; rings that were opened with it do not need it.
void rw_free_description(rw_description *description);

// An axis (0: x, 1: y, 2: z) of evenly spaced nodes of the global grid. `period`: length after which the axis repeats, 0: it does not.
rw_status rw_describe_uniform(rw_description *description, uint32_t axis, double first, double last, uint64_t nodes, double period);

// An axis with its own `nodes` coordinates, strictly ascending.
rw_status rw_describe_rectilinear(rw_description *description, uint32_t axis, const double *coordinates, uint64_t nodes, double period);

// Axes 0 and 1 are longitude and latitude in degrees, on a sphere of this radius; velocities are eastward, northward (and upward).
rw_status rw_describe_sphere(rw_description *description, double radius);

// This process has a block of the global grid: nodes [offset, offset + extent) along x, y, z; blocks must not overlap (leave ghost cells
// out) and cover the grid together. Block `index` is of `count`. Arrays have one value for each of the dimensions.
rw_status rw_describe_block(rw_description *description, uint32_t index, uint32_t count, const uint64_t *offset, const uint64_t *extent);

// A number that all blocks of this start of the simulation name, and those of its next start do not: the clock of one rank, for example,
// that it tells the others. Steps of two starts are then never put together, whatever their blocks are. 0 (default): none.
rw_status rw_describe_start(rw_description *description, uint64_t start);

// Unit of the times, for people; default "s".
rw_status rw_describe_time_unit(rw_description *description, const char *unit);

// Steps that the ring holds; default 4, at least 2. Its memory is that many copies of the block, 4 bytes a value.
rw_status rw_describe_slots(rw_description *description, uint32_t slots);

// When ridgewatch has not taken the step that is to be overwritten: wait for it, so many milliseconds at most, and then not again before
// it moves. 0 (default): overwrite, never wait.
rw_status rw_describe_wait(rw_description *description, uint32_t milliseconds);

// Opens the ring in a folder; null: the folder that `RIDGEWATCH_RING` names, and `RW_OFF` where it is not set. All memory is taken here.
// `*field` is null unless `RW_OK` is returned. The ring of a run that is over is replaced: where there is room for
// both, followers read the old one to its end; where there is not, it is given up for the new one.
rw_status rw_open(const char *ring, const rw_description *description, rw_field **field);

// Publishes a step whose components are arrays of their own, packed, x fastest. `w` is not read in two dimensions.
// `step` must rise from call to call: it tells which blocks of a decomposed domain belong together. Where it does not, the solver counts as set
// back: all blocks must be, at the same step, and none of the steps after it is put together with one from before. Steps that are one block are
// followed by `time` alone, whatever their numbers.
rw_status rw_publish_f32(rw_field *field,
                         uint64_t step,
                         double time,
                         const float *u,
                         const float *v,
                         const float *w);

// The same of doubles, which are rounded to floats.
rw_status rw_publish_f64(rw_field *field, uint64_t step, double time, const double *u, const double *v, const double *w);

// The same with strides, in elements, along x, y, z (two of them in two dimensions): value (i, j, k) of u is
// `u[i * strides[0] + j * strides[1] + k * strides[2]]`. Interleaved components: u = a, v = a + 1, w = a + 2,
// strides {3, 3 nx, 3 nx ny}.
rw_status rw_publish_strided_f32(rw_field *field,
                                 uint64_t step,
                                 double time,
                                 const float *u,
                                 const float *v,
                                 const float *w,
                                 const int64_t *strides);

// The same of doubles, which are rounded to floats.
rw_status rw_publish_strided_f64(rw_field *field,
                                 uint64_t step,
                                 double time,
                                 const double *u,
                                 const double *v,
                                 const double *w,
                                 const int64_t *strides);

// Steps published, and how many of them overwrote one that nobody had taken; either may be null.
rw_status rw_statistics(const rw_field *field, uint64_t *published, uint64_t *overwrote);

// Ends the ring. In a fork it only lets go of the memory. No other thread may be in a call with this handle. Where memory is out
// (`RW_SYSTEM`) the ring stays open and may be closed later.
rw_status rw_close(rw_field *field);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* RIDGEWATCH_H */
