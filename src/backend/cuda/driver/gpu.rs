//! One GPU: probing, context, streams, memory and compiled kernels.
//!
//! [`probe`] checks that the driver and NVRTC libraries are present before anything else, because cudarc panics if they are not. Each [`Gpu`] has
//! three streams: one for kernels, one for uploads and one for asynchronous readback.

use crate::cuda::DeviceError;
use crate::cuda::driver::compile::{self, KernelCache};
use crate::cuda::driver::memory::{Budget, Buffer};
use crate::cuda::driver::readback::AsyncReadback;
use crate::cuda::driver_error;
use cudarc::driver::{CudaContext, CudaEvent, CudaFunction, CudaModule, CudaStream, DeviceRepr, result, sys};
use cudarc::nvrtc::Ptx;
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// Oldest supported driver, CUDA 12.0: stream-ordered allocation and lazy loading are used.
const OLDEST_DRIVER: i32 = 12_000;

/// Settings of an opened GPU.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GpuSettings {
    /// Limit on device memory, bytes. `None`: 90 % of the memory that is free at start.
    pub memory_cap: Option<u64>,
    /// Folder of the kernel cache. `None`: the user's cache folder.
    pub cache: Option<std::path::PathBuf>,
    /// Uses the lowest stream priority, for a GPU that is shared with a solver.
    pub low_priority: bool,
    /// For tests: fills new device memory with bytes that are NaN as floats and out of range as indices, so that reads of uninitialised memory
    /// show.
    pub poison: bool,
}

/// A device found by [`probe`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDevice {
    /// N of cuda:N.
    pub ordinal: u32,
    /// Marketing name.
    pub name: String,
}

/// One opened GPU, shared by all its users. All methods may be called from any thread.
pub struct Gpu {
    ordinal: u32,
    name: String,
    capability: (i32, i32),
    multiprocessors: u32,
    shared_memory: usize,
    driver_version: i32,
    context: Arc<CudaContext>,
    work: Arc<CudaStream>,
    transfer: Arc<CudaStream>,
    readback: AsyncReadback,
    budget: Arc<Budget>,
    cache: KernelCache,
    /// Loaded modules by source and macros. A compile error is stored too, so that no later frame tries again.
    modules: Mutex<HashMap<String, Result<Arc<CudaModule>, DeviceError>>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gpu(cuda:{} {})", self.ordinal, self.name)
    }
}

/// Lists the devices. Opens no device, allocates no device memory and never panics.
///
/// # Errors
/// The driver or NVRTC is missing, does not start or is too old, or no device is present.
pub fn probe() -> Result<Vec<FoundDevice>, DeviceError> {
    // SAFETY: this only searches for the library. It comes first because cudarc panics if the library is absent.
    if !unsafe { sys::is_culib_present() } {
        return Err(DeviceError::NoDriver);
    }
    let start = |error: result::DriverError| DeviceError::DriverStart { reason: format!("{error:?}") };
    result::init().map_err(start)?;
    let found = driver_version()?;
    if found < OLDEST_DRIVER {
        return Err(DeviceError::DriverTooOld { found, needed: OLDEST_DRIVER });
    }
    let count = result::device::get_count().map_err(start)?;
    if count <= 0 {
        return Err(DeviceError::NoDevice);
    }
    // SAFETY: this only searches for the library.
    if !unsafe { cudarc::nvrtc::sys::is_culib_present() } {
        return Err(DeviceError::NoNvrtc);
    }
    (0..count)
        .map(|n| {
            let device = result::device::get(n).map_err(start)?;
            Ok(FoundDevice { ordinal: n as u32, name: result::device::get_name(device).map_err(start)? })
        })
        .collect()
}

/// Returns the CUDA version that the driver supports, 1000 * major + 10 * minor. The library must be present.
fn driver_version() -> Result<i32, DeviceError> {
    let mut version = 0;
    // SAFETY: `version` outlives the call, and `probe` found the library.
    unsafe { sys::cuDriverGetVersion(&mut version) }.result().map_err(driver_error("querying the driver version"))?;
    Ok(version)
}

impl Gpu {
    /// Opens cuda:`ordinal`: its primary context (which burn shares), and streams for kernels, uploads and readback.
    ///
    /// # Errors
    /// [`probe`] fails, the device does not exist or is too old, or a driver call fails.
    pub fn open(ordinal: u32, settings: &GpuSettings) -> Result<Arc<Self>, DeviceError> {
        let devices = probe()?;
        let Some(found) = devices.iter().find(|d| d.ordinal == ordinal) else {
            return Err(DeviceError::NoSuchDevice { asked: ordinal, present: devices.len() as u32 });
        };
        let opening = driver_error("opening the device");
        let context = CudaContext::new(ordinal as usize).map_err(&opening)?;
        let capability = context.compute_capability().map_err(&opening)?;
        if capability < (7, 0) {
            return Err(DeviceError::TooOld { device: ordinal, capability });
        }
        // SAFETY: if a buffer is used on a stream other than its own, this crate orders the use by events (`DeviceSnapshot::ready`,
        // `Buffer::read_by`).
        unsafe { context.disable_event_tracking() };
        let stream = || {
            if settings.low_priority {
                let (least, _) = result::stream::get_priority_range()?;
                context.new_stream_with_priority(least)
            } else {
                context.new_stream()
            }
        };
        let (work, transfer) = (stream().map_err(&opening)?, stream().map_err(&opening)?);
        let readback = AsyncReadback::new(stream().map_err(&opening)?, work.clone());
        let (free, total) = context.mem_get_info().map_err(&opening)?;
        let attribute = |which| context.attribute(which).map_err(&opening);
        let multiprocessors = attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)? as u32;
        let shared_memory = attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN)? as usize;
        let gpu = Self {
            ordinal,
            name: found.name.clone(),
            capability,
            multiprocessors,
            shared_memory,
            driver_version: driver_version()?,
            work,
            transfer,
            readback,
            budget: Arc::new(Budget::new(settings.memory_cap, free as u64, total as u64).filling(settings.poison.then_some(0xFF))),
            cache: KernelCache::new(settings.cache.clone()),
            modules: Mutex::new(HashMap::new()),
            context,
        };
        gpu.keep_freed_memory()?;
        Ok(Arc::new(gpu))
    }

    /// Keeps freed memory in the driver's pool up to the cap, because returning it to the system at each synchronisation costs milliseconds.
    fn keep_freed_memory(&self) -> Result<(), DeviceError> {
        if !self.context.has_async_alloc() {
            return Ok(());
        }
        let doing = driver_error("setting the release threshold of the memory pool");
        let mut threshold: u64 = self.budget.cap();
        // SAFETY: the pool is the device's own, the attribute's type is u64, and `threshold` outlives the call.
        unsafe {
            let pool = result::device::get_mem_pool(self.context.cu_device()).map_err(&doing)?;
            let attribute = sys::CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
            result::mem_pool::set_attribute(pool, attribute, (&raw mut threshold).cast()).map_err(&doing)
        }
    }

    /// N of cuda:N.
    pub fn ordinal(&self) -> u32 {
        self.ordinal
    }
    /// Marketing name.
    pub fn name(&self) -> &str {
        &self.name
    }
    /// Compute capability, (major, minor).
    pub fn capability(&self) -> (i32, i32) {
        self.capability
    }
    /// Number of multiprocessors.
    pub fn multiprocessors(&self) -> u32 {
        self.multiprocessors
    }
    /// Maximum shared memory of a block, bytes (opt-in limit).
    pub fn shared_memory(&self) -> usize {
        self.shared_memory
    }
    /// CUDA version that the driver supports, e.g. `13.0`.
    pub fn driver(&self) -> String {
        format!("{}.{}", self.driver_version / 1000, self.driver_version % 1000 / 10)
    }
    /// The primary context.
    pub fn context(&self) -> &Arc<CudaContext> {
        &self.context
    }
    /// The stream of kernels.
    pub fn work(&self) -> &Arc<CudaStream> {
        &self.work
    }
    /// The stream of snapshot uploads.
    pub fn transfer(&self) -> &Arc<CudaStream> {
        &self.transfer
    }
    pub(in crate::cuda) fn readback(&self) -> &AsyncReadback {
        &self.readback
    }
    pub(in crate::cuda) fn budget(&self) -> &Arc<Budget> {
        &self.budget
    }
    /// Bytes in use and the limit, bytes.
    pub fn memory(&self) -> (u64, u64) {
        (self.budget.used(), self.budget.cap())
    }
    /// Bytes left under the cap.
    pub fn memory_left(&self) -> u64 {
        self.budget.cap().saturating_sub(self.budget.used())
    }

    /// Returns the batch size for items of `bytes` bytes: as many as fit in a quarter of the free memory, at most `most`, and at least 4096 (or
    /// `most`, if that is smaller).
    pub(in crate::cuda) fn batch(&self, most: usize, bytes: u64) -> usize {
        const SHARE: u64 = 4;
        const MIN: usize = 1 << 12;
        usize::try_from(self.memory_left() / SHARE / bytes).unwrap_or(most).max(MIN).min(most)
    }

    /// Allocates uninitialised memory for `len` values, within the cap. It is freed in the order of the work stream.
    ///
    /// # Errors
    /// [`DeviceError::OutOfMemory`], or a driver call fails.
    pub fn alloc<T: DeviceRepr>(&self, what: &str, len: usize) -> Result<Buffer<T>, DeviceError> {
        Buffer::new(&self.work, &self.budget, what, len)
    }

    /// Copies values to newly allocated memory.
    ///
    /// # Errors
    /// As for [`Self::alloc`].
    pub fn upload<T: DeviceRepr>(&self, what: &str, values: &[T]) -> Result<Buffer<T>, DeviceError> {
        let mut buffer = self.alloc(what, values.len())?;
        buffer.write(values)?;
        Ok(buffer)
    }

    /// Returns the compiled kernels of one source file (see [`compile::SOURCES`]) with these macros, e.g. `RW_DIMS=3`. They are compiled once; later
    /// calls return the loaded module, and later runs use the cache on disk.
    ///
    /// # Errors
    /// The source does not compile, or the driver cannot load the module.
    pub fn module(&self, source: &str, defines: &[String]) -> Result<Arc<CudaModule>, DeviceError> {
        let key = format!("{source} {}", defines.join(" "));
        let mut modules = self.modules.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(module) = modules.get(&key) {
            return module.clone();
        }
        let load = |cubin: Vec<u8>| self.context.load_module(Ptx::from_binary(cubin)).map_err(driver_error("loading kernels"));
        let request = compile::Request::new(source, self.capability, defines)?;
        let module = match self.cache.find(&request).map(load) {
            Some(Ok(module)) => module,
            Some(Err(error)) if error.is_out_of_memory() => return Err(error),
            // A cached module that the driver rejects is compiled again.
            Some(Err(_)) | None => {
                let cubin = match request.compile() {
                    Ok(cubin) => cubin,
                    Err(error) => {
                        modules.insert(key, Err(error.clone()));
                        return Err(error);
                    }
                };
                self.cache.keep(&request, &cubin);
                load(cubin)?
            }
        };
        modules.insert(key, Ok(module.clone()));
        Ok(module)
    }

    /// Returns one kernel of a source file.
    ///
    /// # Errors
    /// As for [`Self::module`]; or the module has no kernel of this name.
    pub fn kernel(&self, source: &str, defines: &[String], name: &str) -> Result<CudaFunction, DeviceError> {
        self.module(source, defines)?.load_function(name).map_err(driver_error("finding a kernel"))
    }

    /// Waits for all work enqueued on the work stream.
    ///
    /// # Errors
    /// That work, or the driver call, fails.
    pub fn synchronize(&self) -> Result<(), DeviceError> {
        self.work.synchronize().map_err(driver_error("waiting for the device"))
    }

    /// Records an event on the work stream, to measure time or to make another stream wait.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn mark(&self) -> Result<CudaEvent, DeviceError> {
        self.work.record_event(Some(sys::CUevent_flags::CU_EVENT_DEFAULT)).map_err(driver_error("recording an event"))
    }

    /// Returns the device time between two events in milliseconds. Waits for the second event.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn milliseconds(&self, from: &CudaEvent, to: &CudaEvent) -> Result<f32, DeviceError> {
        from.elapsed_ms(to).map_err(driver_error("measuring time"))
    }

    /// Returns the peak clock rate of the multiprocessors, in Hz.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn top_clock_hz(&self) -> Result<f64, DeviceError> {
        let kilohertz = self.context.attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_CLOCK_RATE);
        Ok(f64::from(kilohertz.map_err(driver_error("querying the clock rate"))?) * 1e3)
    }

    /// Measures the memory bandwidth of the device with a copy of `bytes` bytes: bytes read plus bytes written, per second. It bounds the speed of
    /// every memory-bound kernel.
    ///
    /// # Errors
    /// The device fails or lacks memory for two buffers of this size.
    pub fn copy_rate(&self, bytes: usize) -> Result<f64, DeviceError> {
        let doing = driver_error("copying on the device");
        let (mut from, to) = (self.alloc::<u8>("a copy", bytes)?, self.alloc::<u8>("a copy", bytes)?);
        from.fill_bytes(0x5a)?;
        let mut best = f32::INFINITY;
        for _ in 0..5 {
            let begin = self.mark()?;
            // SAFETY: both buffers hold `bytes` bytes and do not overlap.
            unsafe { result::memcpy_dtod_async(to.address(), from.address(), bytes, self.work.cu_stream()) }.map_err(&doing)?;
            best = best.min(self.milliseconds(&begin, &self.mark()?)?);
        }
        Ok(2.0 * bytes as f64 / f64::from(best) * 1e3)
    }
}
