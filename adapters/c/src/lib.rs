//! C ABI of [`ridgewatch_wire::Producer`]. `include/ridgewatch.h` is generated from this file (`make header`), including its comments.
//!
//! No function unwinds into C or aborts: bodies run under `catch_unwind`, and every fault is a status with a text in [`rw_error`]. Rust aborts if a small
//! allocation fails. Therefore large memory is reserved fallibly (`copied`), and functions that describe or open first test whether the memory for all small
//! allocations is available (`SMALL`).
//!
//! # Safety
//! C guarantees for each pointer: it is null, or it comes from this library and was not freed, or it points to as many values as the function's comment says.
//! Texts end with a zero. Only one thread at a time uses a description or calls `rw_close`.

// The module documentation has one Safety section for all functions.
#![allow(clippy::missing_safety_doc)]

use ridgewatch_wire::{
    AXIS_NODES, AxisDescription, BlockExtent, Description, Element, Field, Geometry, Policy, Producer, TEXT, WireError, even,
    ring_from_environment,
};
use std::cell::RefCell;
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Result of a call.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
// C enumerators share one namespace, so they need the prefix.
#[allow(clippy::enum_variant_names)]
pub enum Status {
    /// Success.
    RwOk = 0,
    /// The handle is null, or no ring was requested: nothing was done.
    RwOff = 1,
    /// An argument is invalid.
    RwArgument = 2,
    /// Another producer has the ring.
    RwInUse = 3,
    /// There is no room for the ring, or it exceeds the process limit of a file's length.
    RwNoSpace = 4,
    /// The folder or a file belongs to another user, or others may write into it.
    RwForeign = 5,
    /// A system call failed, or there is no memory.
    RwSystem = 6,
    /// The parent process opened the handle.
    RwForked = 7,
    /// Internal error of this library.
    RwInternal = 8,
    /// The ring's file was removed or replaced, so no follower finds it: nothing was published. Close the ring, and open it again.
    RwRemoved = 9,
}

/// Version of this header.
pub const RW_VERSION: u32 = 2;
const DEFAULT_SLOTS: u32 = 4;

/// Description of a grid.
#[derive(Debug)]
pub struct RwDescription {
    geometry: Geometry,
    start: u64,
    axes: Vec<Option<AxisDescription>>,
    block: Option<BlockExtent>,
    time_unit: String,
    slots: u32,
    wait: Duration,
}

/// An open ring.
#[derive(Debug)]
pub struct RwField {
    producer: Producer,
    dimensions: usize,
    extent: [u64; 3],
    published: AtomicU64,
    overwrote: AtomicU64,
}

/// Bytes of the longest error text, including its final zero.
const MESSAGE: usize = 512;

thread_local! {
    /// Fixed length: an error of `rw_publish_*` allocates nothing.
    static ERROR: RefCell<[u8; MESSAGE]> = const { RefCell::new([0; MESSAGE]) };
}

/// Error of a call.
enum Failure {
    Off,
    /// An invalid argument. The text is in [`ERROR`] already, because calls after opening allocate nothing.
    Argument,
    Wire(WireError),
}

impl From<WireError> for Failure {
    fn from(error: WireError) -> Self {
        Self::Wire(error)
    }
}

impl Failure {
    fn status(&self) -> Status {
        match self {
            Failure::Off => Status::RwOff,
            Failure::Argument => Status::RwArgument,
            Failure::Wire(error) => match error {
                WireError::InUse { .. } => Status::RwInUse,
                WireError::NoSpace { .. } | WireError::FileSize { .. } => Status::RwNoSpace,
                WireError::Foreign { .. } | WireError::ForeignFolder { .. } => Status::RwForeign,
                WireError::Forked { .. } => Status::RwForked,
                WireError::Removed => Status::RwRemoved,
                WireError::Io { .. } | WireError::NoMemory { .. } | WireError::NotInMemory { .. } => Status::RwSystem,
                _ => Status::RwArgument,
            },
        }
    }
}

/// Writes to a thread's error text, as much as fits.
struct Message<'a>(&'a mut [u8; MESSAGE], usize);

impl std::fmt::Write for Message<'_> {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        let room = MESSAGE - 1 - self.1;
        let mut length = text.len().min(room);
        // Complete characters only.
        while !text.is_char_boundary(length) {
            length -= 1;
        }
        self.0[self.1..self.1 + length].copy_from_slice(&text.as_bytes()[..length]);
        self.1 += length;
        Ok(())
    }
}

fn set_error(text: std::fmt::Arguments) {
    // A thread that ends has no error text any more.
    let _ = ERROR.try_with(|error| {
        if let Ok(mut error) = error.try_borrow_mut() {
            let mut message = Message(&mut error, 0);
            let _ = std::fmt::write(&mut message, text);
            let end = message.1;
            error[end] = 0;
        }
    });
}

/// Error of an argument, with the value found and the accepted values.
fn refused(argument: &str, found: impl std::fmt::Display, accepted: std::fmt::Arguments) -> Failure {
    set_error(format_args!("`{argument}` is {found}; accepted: {accepted}"));
    Failure::Argument
}

/// Most bytes that one call allocates besides coordinates: texts, paths, handles and error texts. The number of blocks does not matter, because those of a folder
/// are examined one after another. The value is below malloc's mmap threshold, so that memory that was reserved and freed is available afterwards.
const SMALL: usize = 1 << 16;

/// Most bytes of a ring's path: the system's limit. [`SMALL`] covers the copies of a path.
const PATH: usize = 4095;

/// Reserves memory.
fn room<T>(count: usize) -> Result<Vec<T>, WireError> {
    let mut room = Vec::new();
    room.try_reserve_exact(count).map_err(|_| WireError::NoMemory { bytes: count.saturating_mul(size_of::<T>()) })?;
    Ok(room)
}

/// Copies coordinates to memory that was reserved.
fn copied(coordinates: impl ExactSizeIterator<Item = f64>) -> Result<Vec<f64>, WireError> {
    let mut copy = room(coordinates.len())?;
    copy.extend(coordinates);
    Ok(copy)
}

/// [`guarded`] for functions that allocate.
fn guarded_with_room(body: impl FnOnce() -> Result<(), Failure>) -> Status {
    guarded(|| {
        // The black box keeps the allocation from being optimised away.
        std::hint::black_box(&mut room::<u8>(SMALL)?);
        body()
    })
}

/// Runs a body, and returns errors and panics as a status.
fn guarded(body: impl FnOnce() -> Result<(), Failure>) -> Status {
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => {
            set_error(format_args!(""));
            Status::RwOk
        }
        Ok(Err(failure)) => {
            match &failure {
                Failure::Off => set_error(format_args!("")),
                Failure::Argument => {}
                Failure::Wire(error) => set_error(format_args!("{error}")),
            }
            failure.status()
        }
        Err(_) => {
            set_error(format_args!("an internal error of the adapter"));
            Status::RwInternal
        }
    }
}

/// Version of the library. It differs from `RW_VERSION` if the header belongs to another library.
#[unsafe(no_mangle)]
pub extern "C" fn rw_version() -> u32 {
    RW_VERSION
}

/// Text of the error of this thread's last call; empty if it succeeded. Valid until the thread's next call.
#[unsafe(no_mangle)]
pub extern "C" fn rw_error() -> *const c_char {
    ERROR.try_with(|error| error.as_ptr().cast::<c_char>().cast_const()).unwrap_or(c"".as_ptr())
}

/// Sets the text that `rw_error` returns, for modules of other languages with their own checks. Null: an empty text. Allocates nothing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_set_error(text: *const c_char) {
    // SAFETY: guaranteed by the caller.
    let text = if text.is_null() { c"" } else { unsafe { CStr::from_ptr(text) } };
    set_error(format_args!("{}", text.to_str().unwrap_or("a text that is not UTF-8")));
}

/// Begins the description of a grid of 2 or 3 dimensions, whose velocity has as many components. Null if there is no memory or another
/// number of dimensions.
#[unsafe(no_mangle)]
pub extern "C" fn rw_describe(dimensions: u32) -> *mut RwDescription {
    let mut made = std::ptr::null_mut();
    guarded_with_room(|| {
        if !(2..=3).contains(&dimensions) {
            return Err(refused("dimensions", dimensions, format_args!("2 or 3")));
        }
        made = Box::into_raw(Box::new(RwDescription {
            geometry: Geometry::Cartesian,
            start: 0,
            axes: vec![None; dimensions as usize],
            block: None,
            time_unit: "s".into(),
            slots: DEFAULT_SLOTS,
            wait: Duration::ZERO,
        }));
        Ok(())
    });
    made
}

/// Frees a description. Rings that were opened with it do not need it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_free_description(description: *mut RwDescription) {
    guarded(|| {
        if !description.is_null() {
            // SAFETY: guaranteed by the caller.
            drop(unsafe { Box::from_raw(description) });
        }
        Ok(())
    });
}

fn no_description() -> Failure {
    refused("description", "null", format_args!("a result of rw_describe"))
}

/// # Safety
/// `description` is null, or points to a description that no other thread uses.
unsafe fn describe(description: *mut RwDescription, change: impl FnOnce(&mut RwDescription) -> Result<(), Failure>) -> Status {
    // SAFETY: guaranteed by the caller.
    guarded_with_room(|| change(unsafe { description.as_mut() }.ok_or_else(no_description)?))
}

const NAMES: [&str; 3] = ["x", "y", "z"];

/// An axis with its standard name.
fn axis_of(axis: u32, coordinates: Vec<f64>, period: Option<f64>) -> AxisDescription {
    AxisDescription { name: NAMES.get(axis as usize).copied().unwrap_or_default().into(), unit: String::new(), coordinates, period }
}

fn set_axis(
    description: &mut RwDescription,
    axis: u32,
    coordinates: impl ExactSizeIterator<Item = f64>,
    period: f64,
) -> Result<(), Failure> {
    let given = axis_of(axis, copied(coordinates)?, (period != 0.0).then_some(period));
    let dimensions = description.axes.len();
    let place = description.axes.get_mut(axis as usize);
    let place = place.ok_or_else(|| refused("axis", axis, format_args!("0 to {}, in {dimensions} dimensions", dimensions - 1)))?;
    *place = Some(given);
    Ok(())
}

/// Describes an axis (0: x, 1: y, 2: z) of the global grid with evenly spaced nodes. `period`: period of the axis; 0: not periodic.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_uniform(
    description: *mut RwDescription,
    axis: u32,
    first: f64,
    last: f64,
    nodes: u64,
    period: f64,
) -> Status {
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, |d| set_axis(d, axis, even(first, last, nodes), period)) }
}

/// Describes an axis of the global grid by its `nodes` coordinates, strictly ascending.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_rectilinear(
    description: *mut RwDescription,
    axis: u32,
    coordinates: *const f64,
    nodes: u64,
    period: f64,
) -> Status {
    let change = |d: &mut RwDescription| {
        if coordinates.is_null() {
            return Err(refused("coordinates", "null", format_args!("the address of {nodes} numbers")));
        }
        if nodes > AXIS_NODES {
            return Err(refused("nodes", nodes, format_args!("2 to {AXIS_NODES}")));
        }
        // SAFETY: guaranteed by the caller, for a number of nodes that was checked.
        let coordinates = unsafe { std::slice::from_raw_parts(coordinates, nodes as usize) };
        set_axis(d, axis, coordinates.iter().copied(), period)
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Makes axes 0 and 1 longitude and latitude in degrees, on a sphere of this radius. Velocities are eastward, northward (and upward).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_sphere(description: *mut RwDescription, radius: f64) -> Status {
    let change = |d: &mut RwDescription| {
        d.geometry = Geometry::Sphere { radius };
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Describes this process's block of the global grid: nodes [offset, offset + extent) along x, y, z, as block `index` of `count`. All blocks
/// together must cover the grid without overlap (without ghost cells). The arrays have one value per dimension.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_block(
    description: *mut RwDescription,
    index: u32,
    count: u32,
    offset: *const u64,
    extent: *const u64,
) -> Status {
    let change = |d: &mut RwDescription| {
        let dimensions = d.axes.len();
        for (name, numbers) in [("offset", offset), ("extent", extent)] {
            if numbers.is_null() {
                return Err(refused(name, "null", format_args!("the address of {dimensions} numbers")));
            }
        }
        let of = |numbers: *const u64, beyond: u64| {
            std::array::from_fn(|k| {
                if k >= dimensions {
                    return beyond;
                }
                // SAFETY: the caller guarantees one number per dimension.
                unsafe { *numbers.add(k) }
            })
        };
        d.block = Some(BlockExtent { index, count, offset: of(offset, 0), extent: of(extent, 1) });
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Sets a number that all blocks of this start of the simulation share, and the next start does not: for example the clock of one rank,
/// broadcast to the others. Steps of two starts are then never joined, whatever their blocks are. 0 (default): none.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_start(description: *mut RwDescription, start: u64) -> Status {
    let change = |d: &mut RwDescription| {
        d.start = start;
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Sets the unit of the times, for display, at most 64 bytes; default "s".
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_time_unit(description: *mut RwDescription, unit: *const c_char) -> Status {
    let change = |d: &mut RwDescription| {
        if unit.is_null() {
            return Err(refused("unit", "null", format_args!("a text")));
        }
        // SAFETY: guaranteed by the caller.
        let unit = unsafe { CStr::from_ptr(unit) }.to_bytes();
        if unit.len() > TEXT {
            return Err(refused("unit", format_args!("{} bytes long", unit.len()), format_args!("at most {TEXT} bytes")));
        }
        let text = str::from_utf8(unit).map_err(|_| refused("unit", format_args!("\"{}\"", unit.escape_ascii()), format_args!("UTF-8")))?;
        d.time_unit = text.to_owned();
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Sets the number of steps that the ring holds; default 4, at least 2. Its memory is that many copies of the block, 4 bytes per value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_slots(description: *mut RwDescription, slots: u32) -> Status {
    let change = |d: &mut RwDescription| {
        d.slots = slots;
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Sets the longest wait, in milliseconds, for ridgewatch to take the step that would be overwritten. After a timeout the next wait begins only
/// when ridgewatch has taken a step. 0 (default): overwrite, never wait.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_wait(description: *mut RwDescription, milliseconds: u32) -> Status {
    let change = |d: &mut RwDescription| {
        d.wait = Duration::from_millis(milliseconds.into());
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { describe(description, change) }
}

/// Opens the ring in a folder; null: the folder that `RIDGEWATCH_RING` names, or `RW_OFF` if it is not set. All memory is allocated here.
/// `*field` is null unless `RW_OK` is returned. The ring of an earlier run is replaced: followers read it to its end if there is room for
/// both; otherwise it is removed to make room.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_open(ring: *const c_char, description: *const RwDescription, field: *mut *mut RwField) -> Status {
    guarded_with_room(|| {
        // SAFETY: guaranteed by the caller.
        let field = unsafe { field.as_mut() }.ok_or_else(|| refused("field", "null", format_args!("the address of a pointer")))?;
        *field = std::ptr::null_mut();
        let ring = if ring.is_null() {
            ring_from_environment().ok_or(Failure::Off)?
        } else {
            use std::os::unix::ffi::OsStrExt;
            // SAFETY: guaranteed by the caller.
            PathBuf::from(std::ffi::OsStr::from_bytes(unsafe { CStr::from_ptr(ring) }.to_bytes()))
        };
        let bytes = ring.as_os_str().len();
        if bytes > PATH {
            return Err(refused("ring", format_args!("a path of {bytes} bytes"), format_args!("at most {PATH} bytes")));
        }
        // SAFETY: guaranteed by the caller.
        let given = unsafe { description.as_ref() }.ok_or_else(no_description)?;
        let axes = given.axes.len();
        let copy = |(axis, given): (usize, &Option<AxisDescription>)| {
            let missing = || refused("description", format_args!("without axis {axis}"), format_args!("all of its {} axes", axes));
            let given = given.as_ref().ok_or_else(missing)?;
            Ok(axis_of(axis as u32, copied(given.coordinates.iter().copied())?, given.period))
        };
        let axes = given.axes.iter().enumerate().map(copy).collect::<Result<Vec<_>, Failure>>()?;
        let mut description = Description::whole(given.geometry, axes, &given.time_unit);
        description.start = given.start;
        if let Some(block) = given.block {
            description.block = block;
        }
        let (dimensions, extent) = (description.components(), description.block.extent);
        let policy = if given.wait.is_zero() { Policy::NewestWins } else { Policy::Wait(given.wait) };
        let producer = Producer::open(&ring, description, given.slots, policy)?;
        let (published, overwrote) = (AtomicU64::new(0), AtomicU64::new(0));
        *field = Box::into_raw(Box::new(RwField { producer, dimensions, extent, published, overwrote }));
        Ok(())
    })
}

/// # Safety
/// `field` is null or open; the components and strides are as the header says.
unsafe fn publish(
    field: *const RwField,
    step: u64,
    time: f64,
    components: [*const u8; 3],
    element: Element,
    strides: Option<*const i64>,
) -> Status {
    guarded(|| {
        // SAFETY: guaranteed by the caller.
        let field = unsafe { field.as_ref() }.ok_or(Failure::Off)?;
        let components = &components[..field.dimensions];
        let mut values = Field::packed(components, element, field.extent);
        if let Some(strides) = strides {
            if strides.is_null() {
                return Err(refused("strides", "null", format_args!("the address of {} numbers", field.dimensions)));
            }
            for k in 0..field.dimensions {
                // SAFETY: the caller guarantees one stride per dimension.
                values.strides[k] = unsafe { *strides.add(k) } as isize;
            }
        }
        // SAFETY: guaranteed by the caller.
        let published = unsafe { field.producer.publish(step, time, &values) }?;
        field.published.fetch_max(published.count, Ordering::Relaxed);
        field.overwrote.fetch_add(u64::from(published.overwrote), Ordering::Relaxed);
        Ok(())
    })
}

/// Publishes a step whose components are separate packed arrays, x fastest. `w` is not read in two dimensions. `step` must rise from call to
/// call: blocks of a decomposed domain with the same number belong together. A number that does not rise sets the solver back: all blocks must
/// be set back at the same step, and blocks before and after it are never joined. A field in one block is followed by `time` alone, whatever
/// its numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_f32(field: *mut RwField, step: u64, time: f64, u: *const f32, v: *const f32, w: *const f32) -> Status {
    // SAFETY: guaranteed by the caller.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F32, None) }
}

/// `rw_publish_f32` for doubles, which are rounded to floats.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_f64(field: *mut RwField, step: u64, time: f64, u: *const f64, v: *const f64, w: *const f64) -> Status {
    // SAFETY: guaranteed by the caller.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F64, None) }
}

/// `rw_publish_f32` with strides, in elements, along x, y, z (two values in two dimensions): value (i, j, k) of u is
/// `u[i * strides[0] + j * strides[1] + k * strides[2]]`. Interleaved components: u = a, v = a + 1, w = a + 2,
/// strides {3, 3 nx, 3 nx ny}.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_strided_f32(
    field: *mut RwField,
    step: u64,
    time: f64,
    u: *const f32,
    v: *const f32,
    w: *const f32,
    strides: *const i64,
) -> Status {
    // SAFETY: guaranteed by the caller.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F32, Some(strides)) }
}

/// `rw_publish_strided_f32` for doubles, which are rounded to floats.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_strided_f64(
    field: *mut RwField,
    step: u64,
    time: f64,
    u: *const f64,
    v: *const f64,
    w: *const f64,
    strides: *const i64,
) -> Status {
    // SAFETY: guaranteed by the caller.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F64, Some(strides)) }
}

/// Counts the published steps, and those that overwrote a step that no follower had taken; either pointer may be null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_statistics(field: *const RwField, published: *mut u64, overwrote: *mut u64) -> Status {
    guarded(|| {
        // SAFETY: guaranteed by the caller, here and below.
        let field = unsafe { field.as_ref() }.ok_or(Failure::Off)?;
        for (to, from) in [(published, &field.published), (overwrote, &field.overwrote)] {
            // SAFETY: as above.
            if let Some(to) = unsafe { to.as_mut() } {
                *to = from.load(Ordering::Relaxed);
            }
        }
        Ok(())
    })
}

/// Ends the ring; in a fork it only frees the memory. No other thread may use this handle during the call. If there is no memory (`RW_SYSTEM`)
/// the ring stays open and may be closed later.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_close(field: *mut RwField) -> Status {
    guarded_with_room(|| {
        if field.is_null() {
            return Err(Failure::Off);
        }
        // SAFETY: guaranteed by the caller.
        drop(unsafe { Box::from_raw(field) });
        Ok(())
    })
}
