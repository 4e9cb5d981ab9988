/* Publishes a solver's velocity field to ridgewatch: a copy into shared memory, and nothing else.
 *
 * The library has no threads and no sockets, allocates nothing between rw_open and rw_close (not even on errors), and never aborts: every
 * call returns a status. Several threads may use one handle. Signal handlers must not call the library, because it locks a mutex. A fork
 * must open its own ring. With a null handle every call does nothing and returns RW_OFF, so that a solver can always be linked with the
 * library, and publishes only if RIDGEWATCH_RING is set.
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

// Version of this header.
#define RW_VERSION 2

// Result of a call.
typedef enum {
  // Success.
  RW_OK = 0,
  // The handle is null, or no ring was requested: nothing was done.
  RW_OFF = 1,
  // An argument is invalid.
  RW_ARGUMENT = 2,
  // Another producer has the ring.
  RW_IN_USE = 3,
  // There is no room for the ring, or it exceeds the process limit of a file's length.
  RW_NO_SPACE = 4,
  // The folder or a file belongs to another user, or others may write into it.
  RW_FOREIGN = 5,
  // A system call failed, or there is no memory.
  RW_SYSTEM = 6,
  // The parent process opened the handle.
  RW_FORKED = 7,
  // Internal error of this library.
  RW_INTERNAL = 8,
  // The ring's file was removed or replaced, so no follower finds it: nothing was published. Close the ring, and open it again.
  RW_REMOVED = 9,
} rw_status;

// Description of a grid.
typedef struct rw_description rw_description;

// An open ring.
typedef struct rw_field rw_field;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Version of the library. It differs from `RW_VERSION` if the header belongs to another library.
uint32_t rw_version(void);

// Text of the error of this thread's last call; empty if it succeeded. Valid until the thread's next call.
const char *rw_error(void);

// Sets the text that `rw_error` returns, for modules of other languages with their own checks. Null: an empty text. Allocates nothing.
void rw_set_error(const char *text);

// Begins the description of a grid of 2 or 3 dimensions, whose velocity has as many components. Null if there is no memory or another
// number of dimensions.
rw_description *rw_describe(uint32_t dimensions);

// Frees a description. Rings that were opened with it do not need it.
void rw_free_description(rw_description *description);

// Describes an axis (0: x, 1: y, 2: z) of the global grid with evenly spaced nodes. `period`: period of the axis; 0: not periodic.
rw_status rw_describe_uniform(rw_description *description, uint32_t axis, double first, double last, uint64_t nodes, double period);

// Describes an axis of the global grid by its `nodes` coordinates, strictly ascending.
rw_status rw_describe_rectilinear(rw_description *description, uint32_t axis, const double *coordinates, uint64_t nodes, double period);

// Makes axes 0 and 1 longitude and latitude in degrees, on a sphere of this radius. Velocities are eastward, northward (and upward).
rw_status rw_describe_sphere(rw_description *description, double radius);

// Describes this process's block of the global grid: nodes [offset, offset + extent) along x, y, z, as block `index` of `count`. All blocks
// together must cover the grid without overlap (without ghost cells). The arrays have one value per dimension.
rw_status rw_describe_block(rw_description *description, uint32_t index, uint32_t count, const uint64_t *offset, const uint64_t *extent);

// Sets a number that all blocks of this start of the simulation share, and the next start does not: for example the clock of one rank,
// broadcast to the others. Steps of two starts are then never joined, whatever their blocks are. 0 (default): none.
rw_status rw_describe_start(rw_description *description, uint64_t start);

// Sets the unit of the times, for display, at most 64 bytes; default "s".
rw_status rw_describe_time_unit(rw_description *description, const char *unit);

// Sets the number of steps that the ring holds; default 4, at least 2. Its memory is that many copies of the block, 4 bytes per value.
rw_status rw_describe_slots(rw_description *description, uint32_t slots);

// Sets the longest wait, in milliseconds, for ridgewatch to take the step that would be overwritten. After a timeout the next wait begins only
// when ridgewatch has taken a step. 0 (default): overwrite, never wait.
rw_status rw_describe_wait(rw_description *description,
                           uint32_t milliseconds);

// Opens the ring in a folder; null: the folder that `RIDGEWATCH_RING` names, or `RW_OFF` if it is not set. All memory is allocated here.
// `*field` is null unless `RW_OK` is returned. The ring of an earlier run is replaced: followers read it to its end if there is room for
// both; otherwise it is removed to make room.
rw_status rw_open(const char *ring, const rw_description *description, rw_field **field);

// Publishes a step whose components are separate packed arrays, x fastest. `w` is not read in two dimensions. `step` must rise from call to
// call: blocks of a decomposed domain with the same number belong together. A number that does not rise sets the solver back: all blocks must
// be set back at the same step, and blocks before and after it are never joined. A field in one block is followed by `time` alone, whatever
// its numbers.
rw_status rw_publish_f32(rw_field *field,
                         uint64_t step,
                         double time,
                         const float *u,
                         const float *v,
                         const float *w);

// `rw_publish_f32` for doubles, which are rounded to floats.
rw_status rw_publish_f64(rw_field *field, uint64_t step, double time, const double *u, const double *v, const double *w);

// `rw_publish_f32` with strides, in elements, along x, y, z (two values in two dimensions): value (i, j, k) of u is
// `u[i * strides[0] + j * strides[1] + k * strides[2]]`. Interleaved components: u = a, v = a + 1, w = a + 2,
// strides {3, 3 nx, 3 nx ny}.
rw_status rw_publish_strided_f32(rw_field *field,
                                 uint64_t step,
                                 double time,
                                 const float *u,
                                 const float *v,
                                 const float *w,
                                 const int64_t *strides);

// `rw_publish_strided_f32` for doubles, which are rounded to floats.
rw_status rw_publish_strided_f64(rw_field *field,
                                 uint64_t step,
                                 double time,
                                 const double *u,
                                 const double *v,
                                 const double *w,
                                 const int64_t *strides);

// Counts the published steps, and those that overwrote a step that no follower had taken; either pointer may be null.
rw_status rw_statistics(const rw_field *field, uint64_t *published, uint64_t *overwrote);

// Ends the ring; in a fork it only frees the memory. No other thread may use this handle during the call. If there is no memory (`RW_SYSTEM`)
// the ring stays open and may be closed later.
rw_status rw_close(rw_field *field);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* RIDGEWATCH_H */
