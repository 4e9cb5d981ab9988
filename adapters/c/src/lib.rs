//! The C ABI over [`ridgewatch_wire::Producer`]. `include/ridgewatch.h` is generated from this file (`make header`), its words are the comments here.
//!
//! Nothing here may unwind into C or abort: bodies run under `catch_unwind`, and every fault is a status with words in [`rw_error`]. Rust aborts
//! where memory is out, so what is large is asked for (`copied`), and whoever describes or opens asks first for what all that is small may take (`SMALL`).
//!
//! What C promises with each pointer that it gives: it is null, or from this library and not yet freed, or points to as many values as the
//! function's comment says; texts end with a zero. A description and `rw_close` are for one thread at a time.

// The promises of the callers stand above, once for all functions.
#![allow(clippy::missing_safety_doc)]

use ridgewatch_wire::{
    AXIS_NODES, AxisDescription, BlockExtent, Description, Element, Field, Geometry, Policy, Producer, RING_VARIABLE, TEXT, WireError, even,
};
use std::cell::RefCell;
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// What a call came to.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
// In C the names of a type's values stand beside all others.
#[allow(clippy::enum_variant_names)]
pub enum Status {
    /// Done.
    RwOk = 0,
    /// No handle, or no ring was asked for: nothing was done.
    RwOff = 1,
    /// A value that cannot be.
    RwArgument = 2,
    /// Another producer has this name.
    RwInUse = 3,
    /// No room for the ring, or it is a longer file than the process may make.
    RwNoSpace = 4,
    /// The folder or file belongs to somebody else.
    RwForeign = 5,
    /// The system refused, or has no memory.
    RwSystem = 6,
    /// The handle was opened by the parent process.
    RwForked = 7,
    /// A fault of this library, which was caught.
    RwInternal = 8,
}

/// Of this version of the header.
pub const RW_VERSION: u32 = 2;
const DEFAULT_SLOTS: u32 = 4;

/// A grid as far as it is described.
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

/// Longest message, with its closing zero.
const MESSAGE: usize = 512;

thread_local! {
    /// Of fixed length: a failure of `rw_publish` takes no memory that is kept.
    static ERROR: RefCell<[u8; MESSAGE]> = const { RefCell::new([0; MESSAGE]) };
}

/// Why a call came to nothing.
enum Failure {
    Off,
    /// An argument that cannot be; the words are in [`ERROR`] already, since the calls after opening take no memory for them.
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
                WireError::Foreign { .. } => Status::RwForeign,
                WireError::Forked { .. } => Status::RwForked,
                WireError::Io { .. } | WireError::NoMemory { .. } | WireError::NotInMemory { .. } => Status::RwSystem,
                _ => Status::RwArgument,
            },
        }
    }
}

/// Writes into a thread's message as much as fits.
struct Message<'a>(&'a mut [u8; MESSAGE], usize);

impl std::fmt::Write for Message<'_> {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        let room = MESSAGE - 1 - self.1;
        let mut length = text.len().min(room);
        // Whole characters only.
        while !text.is_char_boundary(length) {
            length -= 1;
        }
        self.0[self.1..self.1 + length].copy_from_slice(&text.as_bytes()[..length]);
        self.1 += length;
        Ok(())
    }
}

fn tell(text: std::fmt::Arguments) {
    // A thread that is ending has no message any more.
    let _ = ERROR.try_with(|error| {
        if let Ok(mut error) = error.try_borrow_mut() {
            let mut message = Message(&mut error, 0);
            let _ = std::fmt::write(&mut message, text);
            let end = message.1;
            error[end] = 0;
        }
    });
}

/// Refuses an argument: what was found, and what is accepted.
fn refused(argument: &str, found: impl std::fmt::Display, accepted: std::fmt::Arguments) -> Failure {
    tell(format_args!("`{argument}` is {found}; accepted: {accepted}"));
    Failure::Argument
}

/// Most bytes that one call takes beside coordinates: texts, paths, the handles, the words of an error; however many blocks there are, since those of a
/// folder are looked at one by one. Less than from where malloc maps memory of its own, so that what was asked for and given back is there for what follows.
const SMALL: usize = 1 << 16;

/// Longest path of a ring, in bytes: the system's, whose copies [`SMALL`] is for.
const PATH: usize = 4095;

/// Asks for memory.
fn room<T>(count: usize) -> Result<Vec<T>, WireError> {
    let mut room = Vec::new();
    room.try_reserve_exact(count).map_err(|_| WireError::NoMemory { bytes: count.saturating_mul(size_of::<T>()) })?;
    Ok(room)
}

/// Coordinates in memory that was asked for.
fn copied(coordinates: impl ExactSizeIterator<Item = f64>) -> Result<Vec<f64>, WireError> {
    let mut copy = room(coordinates.len())?;
    copy.extend(coordinates);
    Ok(copy)
}

/// [`guarded`] for what takes memory.
fn guarded_with_room(body: impl FnOnce() -> Result<(), Failure>) -> Status {
    guarded(|| {
        // Kept from being optimised away.
        std::hint::black_box(&mut room::<u8>(SMALL)?);
        body()
    })
}

/// Runs a body so that neither an error nor a panic leaves it but as a status.
fn guarded(body: impl FnOnce() -> Result<(), Failure>) -> Status {
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => {
            tell(format_args!(""));
            Status::RwOk
        }
        Ok(Err(failure)) => {
            match &failure {
                Failure::Off => tell(format_args!("")),
                Failure::Argument => {}
                Failure::Wire(error) => tell(format_args!("{error}")),
            }
            failure.status()
        }
        Err(_) => {
            tell(format_args!("an internal fault of the adapter, which was caught"));
            Status::RwInternal
        }
    }
}

/// The library's version; another number than `RW_VERSION`: another header.
#[unsafe(no_mangle)]
pub extern "C" fn rw_version() -> u32 {
    RW_VERSION
}

/// Why the last call of this thread failed; empty when none did. Valid until the thread's next call.
#[unsafe(no_mangle)]
pub extern "C" fn rw_error() -> *const c_char {
    ERROR.try_with(|error| error.as_ptr().cast::<c_char>().cast_const()).unwrap_or(c"".as_ptr())
}

/// Makes this text what `rw_error` returns: for modules of other languages, which refuse what they do not pass on. Null: none. Takes no memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_set_error(text: *const c_char) {
    // SAFETY: the caller's promise.
    let text = if text.is_null() { c"" } else { unsafe { CStr::from_ptr(text) } };
    tell(format_args!("{}", text.to_str().unwrap_or("a text that is not UTF-8")));
}

/// Begins a description of a grid of 2 or 3 dimensions, whose velocity has as many components. Null when there is no memory or the
/// dimensions are wrong.
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

/// Ends a description; rings that were opened with it do not need it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_free_description(description: *mut RwDescription) {
    guarded(|| {
        if !description.is_null() {
            // SAFETY: the caller's promise.
            drop(unsafe { Box::from_raw(description) });
        }
        Ok(())
    });
}

fn no_description() -> Failure {
    refused("description", "null", format_args!("what rw_describe returned"))
}

/// # Safety
/// `description` is null or points to a description that nobody else uses.
unsafe fn describe(description: *mut RwDescription, change: impl FnOnce(&mut RwDescription) -> Result<(), Failure>) -> Status {
    // SAFETY: the caller's promise.
    guarded_with_room(|| change(unsafe { description.as_mut() }.ok_or_else(no_description)?))
}

const NAMES: [&str; 3] = ["x", "y", "z"];

/// What an axis is but for its coordinates.
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

/// An axis (0: x, 1: y, 2: z) of evenly spaced nodes of the global grid. `period`: length after which the axis repeats, 0: it does not.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_uniform(
    description: *mut RwDescription,
    axis: u32,
    first: f64,
    last: f64,
    nodes: u64,
    period: f64,
) -> Status {
    // SAFETY: the caller's promise.
    unsafe { describe(description, |d| set_axis(d, axis, even(first, last, nodes), period)) }
}

/// An axis with its own `nodes` coordinates, strictly ascending.
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
        // SAFETY: the caller's promise, for a number of nodes that was checked.
        let coordinates = unsafe { std::slice::from_raw_parts(coordinates, nodes as usize) };
        set_axis(d, axis, coordinates.iter().copied(), period)
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// Axes 0 and 1 are longitude and latitude in degrees, on a sphere of this radius; velocities are eastward, northward (and upward).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_sphere(description: *mut RwDescription, radius: f64) -> Status {
    let change = |d: &mut RwDescription| {
        d.geometry = Geometry::Sphere { radius };
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// This process has a block of the global grid: nodes [offset, offset + extent) along x, y, z; blocks must not overlap (leave ghost cells
/// out) and cover the grid together. Block `index` is of `count`. Arrays have one value for each of the dimensions.
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
                // SAFETY: a number a dimension, by the caller's promise.
                unsafe { *numbers.add(k) }
            })
        };
        d.block = Some(BlockExtent { index, count, offset: of(offset, 0), extent: of(extent, 1) });
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// A number that all blocks of this start of the simulation name, and those of its next start do not: the clock of one rank, for example,
/// that it tells the others. Steps of two starts are then never put together, whatever their blocks are. 0 (default): none.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_start(description: *mut RwDescription, start: u64) -> Status {
    let change = |d: &mut RwDescription| {
        d.start = start;
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// Unit of the times, for people, 64 bytes at most; default "s".
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_time_unit(description: *mut RwDescription, unit: *const c_char) -> Status {
    let change = |d: &mut RwDescription| {
        if unit.is_null() {
            return Err(refused("unit", "null", format_args!("a text")));
        }
        // SAFETY: the caller's promise.
        let unit = unsafe { CStr::from_ptr(unit) }.to_bytes();
        if unit.len() > TEXT {
            return Err(refused("unit", format_args!("{} bytes long", unit.len()), format_args!("at most {TEXT} bytes")));
        }
        let text = str::from_utf8(unit).map_err(|_| refused("unit", format_args!("\"{}\"", unit.escape_ascii()), format_args!("UTF-8")))?;
        d.time_unit = text.to_owned();
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// Steps that the ring holds; default 4, at least 2. Its memory is that many copies of the block, 4 bytes a value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_slots(description: *mut RwDescription, slots: u32) -> Status {
    let change = |d: &mut RwDescription| {
        d.slots = slots;
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// When ridgewatch has not taken the step that is to be overwritten: wait for it, so many milliseconds at most, and then not again before
/// it moves. 0 (default): overwrite, never wait.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_describe_wait(description: *mut RwDescription, milliseconds: u32) -> Status {
    let change = |d: &mut RwDescription| {
        d.wait = Duration::from_millis(milliseconds.into());
        Ok(())
    };
    // SAFETY: the caller's promise.
    unsafe { describe(description, change) }
}

/// Opens the ring in a folder; null: the folder that `RIDGEWATCH_RING` names, and `RW_OFF` where it is not set. All memory is taken here.
/// `*field` is null unless `RW_OK` is returned. The ring of a run that is over is replaced: where there is room for
/// both, followers read the old one to its end; where there is not, it is given up for the new one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_open(ring: *const c_char, description: *const RwDescription, field: *mut *mut RwField) -> Status {
    guarded_with_room(|| {
        // SAFETY: the caller's promise.
        let field = unsafe { field.as_mut() }.ok_or_else(|| refused("field", "null", format_args!("the address of a pointer")))?;
        *field = std::ptr::null_mut();
        let ring = if ring.is_null() {
            PathBuf::from(std::env::var_os(RING_VARIABLE).filter(|name| !name.is_empty()).ok_or(Failure::Off)?)
        } else {
            use std::os::unix::ffi::OsStrExt;
            // SAFETY: the caller's promise.
            PathBuf::from(std::ffi::OsStr::from_bytes(unsafe { CStr::from_ptr(ring) }.to_bytes()))
        };
        let bytes = ring.as_os_str().len();
        if bytes > PATH {
            return Err(refused("ring", format_args!("a path of {bytes} bytes"), format_args!("at most {PATH} bytes")));
        }
        // SAFETY: the caller's promise.
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
/// `field` is null or open; the components and strides are those of the header.
unsafe fn publish(
    field: *const RwField,
    step: u64,
    time: f64,
    components: [*const u8; 3],
    element: Element,
    strides: Option<*const i64>,
) -> Status {
    guarded(|| {
        // SAFETY: the caller's promise.
        let field = unsafe { field.as_ref() }.ok_or(Failure::Off)?;
        let components = &components[..field.dimensions];
        let mut values = Field::packed(components, element, field.extent);
        if let Some(strides) = strides {
            if strides.is_null() {
                return Err(refused("strides", "null", format_args!("the address of {} numbers", field.dimensions)));
            }
            for k in 0..field.dimensions {
                // SAFETY: a stride a dimension, by the caller's promise.
                values.strides[k] = unsafe { *strides.add(k) } as isize;
            }
        }
        // SAFETY: the caller's promise.
        let published = unsafe { field.producer.publish(step, time, &values) }?;
        field.published.fetch_max(published.count, Ordering::Relaxed);
        field.overwrote.fetch_add(u64::from(published.overwrote), Ordering::Relaxed);
        Ok(())
    })
}

/// Publishes a step whose components are arrays of their own, packed, x fastest. `w` is not read in two dimensions.
/// `step` must rise from call to call: it tells which blocks of a decomposed domain belong together. Where it does not, the solver counts as set
/// back: all blocks must be, at the same step, and none of the steps after it is put together with one from before. Steps that are one block are
/// followed by `time` alone, whatever their numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_f32(field: *mut RwField, step: u64, time: f64, u: *const f32, v: *const f32, w: *const f32) -> Status {
    // SAFETY: the caller's promise.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F32, None) }
}

/// The same of doubles, which are rounded to floats.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_publish_f64(field: *mut RwField, step: u64, time: f64, u: *const f64, v: *const f64, w: *const f64) -> Status {
    // SAFETY: the caller's promise.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F64, None) }
}

/// The same with strides, in elements, along x, y, z (two of them in two dimensions): value (i, j, k) of u is
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
    // SAFETY: the caller's promise.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F32, Some(strides)) }
}

/// The same of doubles, which are rounded to floats.
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
    // SAFETY: the caller's promise.
    unsafe { publish(field, step, time, [u.cast(), v.cast(), w.cast()], Element::F64, Some(strides)) }
}

/// Steps published, and how many of them overwrote one that nobody had taken; either may be null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_statistics(field: *const RwField, published: *mut u64, overwrote: *mut u64) -> Status {
    guarded(|| {
        // SAFETY: the caller's promise, here and below.
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

/// Ends the ring. In a fork it only lets go of the memory. No other thread may be in a call with this handle. Where memory is out
/// (`RW_SYSTEM`) the ring stays open and may be closed later.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rw_close(field: *mut RwField) -> Status {
    guarded_with_room(|| {
        if field.is_null() {
            return Err(Failure::Off);
        }
        // SAFETY: the caller's promise.
        drop(unsafe { Box::from_raw(field) });
        Ok(())
    })
}
